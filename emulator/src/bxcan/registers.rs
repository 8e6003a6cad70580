//! Register offsets and bits, in the order of RM0090, 32.9.
#![allow(unreachable_pub, reason = "a private table reads better without its path in every line")]

/// Master control.
pub mod mcr {
    pub const OFFSET: u32 = 0x000;
    pub const INRQ: u32 = 1 << 0;
    pub const SLEEP: u32 = 1 << 1;
    pub const TXFP: u32 = 1 << 2;
    pub const RFLM: u32 = 1 << 3;
    pub const NART: u32 = 1 << 4;
    pub const AWUM: u32 = 1 << 5;
    pub const ABOM: u32 = 1 << 6;
    pub const RESET: u32 = 1 << 15;
    /// TTCM and DBF are kept and change nothing.
    pub const STORED: u32 = 0x0001_00ff;
    pub const AFTER_RESET: u32 = 0x0001_0002;
}

/// Master status.
pub mod msr {
    pub const OFFSET: u32 = 0x004;
    pub const INAK: u32 = 1 << 0;
    pub const SLAK: u32 = 1 << 1;
    pub const ERRI: u32 = 1 << 2;
    pub const WKUI: u32 = 1 << 3;
    pub const SLAKI: u32 = 1 << 4;
    /// SAMP and RX of a recessive bus.
    pub const RECESSIVE: u32 = 0b11 << 10;
}

/// Transmit status.
pub mod tsr {
    pub const OFFSET: u32 = 0x008;
    /// The bits of mailbox 0; the others' stand 8 and 16 bits higher.
    pub const RQCP: u32 = 1 << 0;
    pub const TXOK: u32 = 1 << 1;
    pub const ALST: u32 = 1 << 2;
    pub const TERR: u32 = 1 << 3;
    pub const ABRQ: u32 = 1 << 7;
    pub const CODE: u32 = 24;
    pub const TME: u32 = 26;
    pub const LOW: u32 = 29;
}

/// Receive FIFO 0 and 1.
pub mod rfr {
    pub const OFFSET_0: u32 = 0x00c;
    pub const OFFSET_1: u32 = 0x010;
    pub const FULL: u32 = 1 << 3;
    pub const FOVR: u32 = 1 << 4;
    pub const RFOM: u32 = 1 << 5;
}

/// Interrupt enable.
pub mod ier {
    pub const OFFSET: u32 = 0x014;
    pub const TMEIE: u32 = 1 << 0;
    /// The bits of FIFO 0; FIFO 1's stand 3 bits higher.
    pub const FMPIE: u32 = 1 << 1;
    pub const FFIE: u32 = 1 << 2;
    pub const FOVIE: u32 = 1 << 3;
    pub const EWGIE: u32 = 1 << 8;
    pub const EPVIE: u32 = 1 << 9;
    pub const BOFIE: u32 = 1 << 10;
    pub const LECIE: u32 = 1 << 11;
    pub const ERRIE: u32 = 1 << 15;
    pub const WKUIE: u32 = 1 << 16;
    pub const SLKIE: u32 = 1 << 17;
    pub const STORED: u32 = 0x0003_8f7f;
}

/// Error status.
pub mod esr {
    pub const OFFSET: u32 = 0x018;
    pub const EWGF: u32 = 1 << 0;
    pub const EPVF: u32 = 1 << 1;
    pub const BOFF: u32 = 1 << 2;
    pub const LEC: u32 = 4;
    pub const TEC: u32 = 16;
}

/// Bit timing.
pub mod btr {
    pub const OFFSET: u32 = 0x01c;
    pub const BRP: u32 = 0;
    pub const TS1: u32 = 16;
    pub const TS2: u32 = 20;
    pub const LBKM: u32 = 1 << 30;
    pub const SILM: u32 = 1 << 31;
    pub const STORED: u32 = 0xc37f_03ff;
    pub const AFTER_RESET: u32 = 0x0123_0000;
}

/// Transmit mailboxes and receive FIFO outputs: four registers each.
pub mod frame {
    pub const MAILBOXES: u32 = 0x180;
    pub const FIFOS: u32 = 0x1b0;
    pub const END: u32 = 0x1d0;

    /// TIxR only: transmission request.
    pub const TXRQ: u32 = 1 << 0;
    /// TIxR, RIxR.
    pub const RTR: u32 = 1 << 1;
    pub const IDE: u32 = 1 << 2;
    pub const EXID: u32 = 3;
    pub const STID: u32 = 21;
    /// RDTxR only: filter match index.
    pub const FMI: u32 = 8;
    /// Bits of TIxR, TDTxR, TDLxR, TDHxR.
    pub const STORED: [u32; 4] = [u32::MAX, 0xffff_010f, u32::MAX, u32::MAX];
}

/// Filters.
pub mod filter {
    pub const FMR: u32 = 0x200;
    pub const FINIT: u32 = 1 << 0;
    pub const CAN2SB: u32 = 8;
    pub const FMR_STORED: u32 = 0x3f01;
    pub const FMR_AFTER_RESET: u32 = 0x2a1c_0e01;
    pub const FM1R: u32 = 0x204;
    pub const FS1R: u32 = 0x20c;
    pub const FFA1R: u32 = 0x214;
    pub const FA1R: u32 = 0x21c;
    pub const BANKS: u32 = 0x240;
    pub const END: u32 = 0x320;
    pub const COUNT: usize = 28;
    pub const ALL: u32 = (1 << COUNT) - 1;
}
