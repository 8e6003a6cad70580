//! Reset and clock control of the STM32F405 (RM0090 chapter 7): the bits that firmware waits for or asks about.
//!
//! Oscillators and PLLs are ready as soon as they are on, provided that what feeds them is: without a crystal the
//! ready bits of HSE and of PLLs fed by it never come. The system clock follows its switch once the chosen source
//! is ready. Frequencies are derived from the registers. Reset-cause flags collect in CSR until RMVF clears them.
//!
//! Not modelled: interrupts, the clock security system, start-up times, the oscillators' trimming, the write
//! protection of the backup domain, and what the enable and reset bits of other peripherals than CAN1 do.

/// Bytes that the registers occupy.
pub const SIZE: u32 = 0x400;

/// Frequency of the internal oscillator.
pub const HSI_HZ: u32 = 16_000_000;
/// Frequency of the board's crystal.
pub const CRYSTAL_HZ: u32 = 8_000_000;

/// Why the machine was reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResetCause {
    /// The supply came up.
    PowerOn,
    /// The NRST pin.
    Pin,
    /// The processor asked for it.
    Software,
    /// The independent watchdog.
    IndependentWatchdog,
    /// The window watchdog.
    WindowWatchdog,
}

/// Where each register stands, in the manual's order.
mod offset {
    pub(super) const CR: u32 = 0x00;
    pub(super) const PLLCFGR: u32 = 0x04;
    pub(super) const CFGR: u32 = 0x08;
    pub(super) const APB1RSTR: u32 = 0x20;
    pub(super) const AHB1ENR: u32 = 0x30;
    pub(super) const APB1ENR: u32 = 0x40;
    pub(super) const AHB1LPENR: u32 = 0x50;
    pub(super) const AHB2LPENR: u32 = 0x54;
    pub(super) const AHB3LPENR: u32 = 0x58;
    pub(super) const APB1LPENR: u32 = 0x60;
    pub(super) const APB2LPENR: u32 = 0x64;
    pub(super) const BDCR: u32 = 0x70;
    pub(super) const CSR: u32 = 0x74;
    pub(super) const PLLI2SCFGR: u32 = 0x84;
    /// Behind the last register.
    pub(super) const END: u32 = 0x88;
}

/// Values after a system reset, where not 0. CSR keeps its upper half and BDCR everything.
const AFTER_RESET: [(u32, u32); 9] = [
    (offset::CR, 0x0000_0083),
    (offset::PLLCFGR, 0x2400_3010),
    (offset::AHB1ENR, 0x0010_0000),
    (offset::AHB1LPENR, 0x7e67_91ff),
    (offset::AHB2LPENR, 0x0000_00f1),
    (offset::AHB3LPENR, 0x0000_0001),
    (offset::APB1LPENR, 0x36fe_c9ff),
    (offset::APB2LPENR, 0x0007_5f33),
    (offset::PLLI2SCFGR, 0x2000_3000),
];

mod cr {
    pub(super) const HSION: u32 = 1 << 0;
    pub(super) const HSIRDY: u32 = 1 << 1;
    pub(super) const HSEON: u32 = 1 << 16;
    pub(super) const HSERDY: u32 = 1 << 17;
    pub(super) const HSEBYP: u32 = 1 << 18;
    pub(super) const PLLON: u32 = 1 << 24;
    pub(super) const PLLRDY: u32 = 1 << 25;
    pub(super) const PLLI2SON: u32 = 1 << 26;
    pub(super) const PLLI2SRDY: u32 = 1 << 27;
    pub(super) const READY: u32 = HSIRDY | HSERDY | PLLRDY | PLLI2SRDY;
}

mod pllcfgr {
    pub(super) const PLLM: u32 = 0;
    pub(super) const PLLN: u32 = 6;
    pub(super) const PLLP: u32 = 16;
    pub(super) const PLLSRC: u32 = 1 << 22;
}

mod cfgr {
    pub(super) const SW: u32 = 0b11;
    pub(super) const SWS: u32 = 0b11 << 2;
    pub(super) const HPRE: u32 = 4;
    pub(super) const PPRE1: u32 = 10;
}

/// APB1RSTR and APB1ENR.
const CAN1: u32 = 1 << 25;

/// BDCR and CSR: an oscillator's switch and ready bit.
const LSON: u32 = 1 << 0;
const LSRDY: u32 = 1 << 1;
/// BDCR: resets the backup domain.
const BDRST: u32 = 1 << 16;

mod csr {
    pub(super) const RMVF: u32 = 1 << 24;
    pub(super) const BORRSTF: u32 = 1 << 25;
    pub(super) const PINRSTF: u32 = 1 << 26;
    pub(super) const PORRSTF: u32 = 1 << 27;
    pub(super) const SFTRSTF: u32 = 1 << 28;
    pub(super) const IWDGRSTF: u32 = 1 << 29;
    pub(super) const WWDGRSTF: u32 = 1 << 30;
    pub(super) const FLAGS: u32 = 0xfe00_0000;
}

/// The clock control of one machine.
#[derive(Debug, Clone)]
pub struct Rcc {
    registers: [u32; (offset::END / 4) as usize],
    crystal: bool,
}

impl Default for Rcc {
    fn default() -> Self {
        let mut rcc = Self { registers: [0; (offset::END / 4) as usize], crystal: true };
        rcc.reset(ResetCause::PowerOn);
        rcc
    }
}

impl Rcc {
    /// Clock control after power-on, with a crystal.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A system reset. Every one but power-on keeps the backup domain and adds its flag to those not yet cleared;
    /// an internal one drives the NRST pin too, and so sets that flag as well.
    pub fn reset(&mut self, cause: ResetCause) {
        let (flags, backup) = match cause {
            ResetCause::PowerOn => (csr::PORRSTF | csr::BORRSTF, 0),
            ResetCause::Pin => (0, self.get(offset::BDCR)),
            ResetCause::Software => (csr::SFTRSTF, self.get(offset::BDCR)),
            ResetCause::IndependentWatchdog => (csr::IWDGRSTF, self.get(offset::BDCR)),
            ResetCause::WindowWatchdog => (csr::WWDGRSTF, self.get(offset::BDCR)),
        };
        let kept = if cause == ResetCause::PowerOn { 0 } else { self.get(offset::CSR) & csr::FLAGS };
        self.registers.fill(0);
        for (register, value) in AFTER_RESET {
            self.set(register, value);
        }
        self.set(offset::BDCR, backup);
        self.set(offset::CSR, kept | flags | csr::PINRSTF);
    }

    /// Whether the board has its crystal (it has); taking it away also stops what it feeds.
    pub fn set_crystal(&mut self, fitted: bool) {
        self.crystal = fitted;
        self.settle();
    }

    /// Frequency of the processor's clock.
    #[must_use]
    pub fn sysclk_hz(&self) -> u32 {
        match (self.get(offset::CFGR) & cfgr::SWS) >> 2 {
            1 => CRYSTAL_HZ,
            2 => self.pll_hz(),
            _ => HSI_HZ,
        }
    }

    /// Frequency of the AHB.
    #[must_use]
    pub fn hclk_hz(&self) -> u32 {
        // From 64 on the divisors skip 32.
        let shift = match self.get(offset::CFGR) >> cfgr::HPRE & 0xf {
            code @ 8..=11 => code - 7,
            code @ 12..=15 => code - 6,
            _ => 0,
        };
        self.sysclk_hz() >> shift
    }

    /// Frequency of the APB1, which clocks the CAN controllers.
    #[must_use]
    pub fn pclk1_hz(&self) -> u32 {
        let shift = match self.get(offset::CFGR) >> cfgr::PPRE1 & 0x7 {
            code @ 4..=7 => code - 3,
            _ => 0,
        };
        self.hclk_hz() >> shift
    }

    /// Frequency of the timers on the APB1: twice that of the bus, unless that runs as fast as the AHB.
    #[must_use]
    pub fn timclk1_hz(&self) -> u32 {
        let (hclk, pclk1) = (self.hclk_hz(), self.pclk1_hz());
        if hclk == pclk1 { pclk1 } else { 2 * pclk1 }
    }

    /// Whether CAN1 is held in reset.
    #[must_use]
    pub const fn can1_is_reset(&self) -> bool {
        self.get(offset::APB1RSTR) & CAN1 != 0
    }

    /// Whether CAN1 has its clock; without it the registers can't be reached.
    #[must_use]
    pub const fn can1_is_clocked(&self) -> bool {
        self.get(offset::APB1ENR) & CAN1 != 0
    }

    /// Reads the register at a byte offset; one that is not there is 0.
    #[must_use]
    pub fn read(&self, offset: u32) -> u32 {
        self.registers.get(offset as usize / 4).copied().unwrap_or(0)
    }

    /// Writes the register at a byte offset.
    pub fn write(&mut self, offset: u32, value: u32) {
        match offset {
            offset::CFGR => {
                let status = self.get(offset::CFGR) & cfgr::SWS;
                self.set(offset, value & !cfgr::SWS | status);
            }
            offset::BDCR if value & BDRST != 0 => self.set(offset, BDRST),
            offset::CSR => {
                let flags = if value & csr::RMVF == 0 { self.get(offset) & csr::FLAGS } else { 0 };
                self.set(offset, value & LSON | flags);
            }
            0..offset::END => self.set(offset, value),
            _ => {}
        }
        self.settle();
    }

    const fn get(&self, offset: u32) -> u32 {
        self.registers[offset as usize / 4]
    }

    const fn set(&mut self, offset: u32, value: u32) {
        self.registers[offset as usize / 4] = value;
    }

    /// Brings the ready bits up to date, then the system clock.
    fn settle(&mut self) {
        let on = self.get(offset::CR);
        let external = on & cr::HSEON != 0 && (self.crystal || on & cr::HSEBYP != 0);
        let internal = on & cr::HSION != 0;
        let source = if self.get(offset::PLLCFGR) & pllcfgr::PLLSRC != 0 { external } else { internal };
        let ready = [
            (internal, cr::HSIRDY),
            (external, cr::HSERDY),
            (source && on & cr::PLLON != 0, cr::PLLRDY),
            (source && on & cr::PLLI2SON != 0, cr::PLLI2SRDY),
        ];
        let bits = ready.iter().filter(|(is_ready, _)| *is_ready).fold(0, |bits, (_, bit)| bits | bit);
        self.set(offset::CR, on & !cr::READY | bits);
        self.settle_low_speed(offset::BDCR);
        self.settle_low_speed(offset::CSR);

        let configuration = self.get(offset::CFGR);
        let switch = configuration & cfgr::SW;
        let chosen = [cr::HSIRDY, cr::HSERDY, cr::PLLRDY].get(switch as usize).copied().unwrap_or(0);
        if bits & chosen != 0 {
            self.set(offset::CFGR, configuration & !cfgr::SWS | switch << 2);
        }
    }

    fn settle_low_speed(&mut self, register: u32) {
        let value = self.get(register);
        let ready = if value & LSON != 0 { LSRDY } else { 0 };
        self.set(register, value & !LSRDY | ready);
    }

    fn pll_hz(&self) -> u32 {
        let configuration = self.get(offset::PLLCFGR);
        let field = |at: u32, width: u32| u64::from(configuration >> at & ((1 << width) - 1));
        let source = if configuration & pllcfgr::PLLSRC != 0 { CRYSTAL_HZ } else { HSI_HZ };
        let vco = u64::from(source) * field(pllcfgr::PLLN, 9) / field(pllcfgr::PLLM, 6).max(1);
        // At most 16 MHz times 511, halved: more than 32 bits hold, and no setting that hardware allows.
        u32::try_from(vco / (2 * (field(pllcfgr::PLLP, 2) + 1))).unwrap_or(u32::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Crystal, PLL at M 8, N 336, P 2, HPRE 1, PPRE1 4: what runs an F405 at 168 MHz.
    fn at_168_mhz(rcc: &mut Rcc) {
        rcc.write(offset::CR, rcc.read(offset::CR) | cr::HSEON);
        rcc.write(offset::PLLCFGR, pllcfgr::PLLSRC | 8 | 336 << pllcfgr::PLLN | 7 << 24);
        rcc.write(offset::CR, rcc.read(offset::CR) | cr::PLLON);
        rcc.write(offset::CFGR, 5 << cfgr::PPRE1 | 4 << 13);
        rcc.write(offset::CFGR, rcc.read(offset::CFGR) | 2);
    }

    #[test]
    fn starts_from_the_internal_oscillator() {
        let rcc = Rcc::new();
        assert_eq!(rcc.read(offset::CR), 0x83);
        assert_eq!(rcc.read(offset::CSR), 0x0e00_0000);
        assert_eq!((rcc.sysclk_hz(), rcc.hclk_hz(), rcc.pclk1_hz()), (HSI_HZ, HSI_HZ, HSI_HZ));
    }

    #[test]
    fn frequencies_follow_the_registers() {
        let mut rcc = Rcc::new();
        at_168_mhz(&mut rcc);
        assert_eq!(rcc.read(offset::CR) & cr::READY, cr::HSIRDY | cr::HSERDY | cr::PLLRDY);
        assert_eq!(rcc.read(offset::CFGR) & cfgr::SWS, 2 << 2);
        assert_eq!((rcc.sysclk_hz(), rcc.pclk1_hz()), (168_000_000, 42_000_000));
        rcc.write(offset::CFGR, 1 | 12 << cfgr::HPRE | 4 << cfgr::PPRE1);
        assert_eq!((rcc.sysclk_hz(), rcc.hclk_hz(), rcc.pclk1_hz()), (8_000_000, 125_000, 62_500));
    }

    #[test]
    fn without_a_crystal_its_ready_bits_never_come() {
        let mut rcc = Rcc::new();
        rcc.set_crystal(false);
        at_168_mhz(&mut rcc);
        assert_eq!(rcc.read(offset::CR) & cr::READY, cr::HSIRDY);
        assert_eq!(rcc.read(offset::CFGR) & cfgr::SWS, 0);
        assert_eq!(rcc.sysclk_hz(), HSI_HZ);
        rcc.set_crystal(true);
        assert_eq!(rcc.sysclk_hz(), 168_000_000);
    }

    #[test]
    fn the_internal_oscillator_feeds_the_pll_too() {
        let mut rcc = Rcc::new();
        rcc.set_crystal(false);
        rcc.write(offset::PLLCFGR, 16 | 336 << pllcfgr::PLLN);
        rcc.write(offset::CR, rcc.read(offset::CR) | cr::PLLON);
        rcc.write(offset::CFGR, 2);
        assert_eq!(rcc.sysclk_hz(), 168_000_000);
    }

    #[test]
    fn the_status_of_the_switch_is_not_written() {
        let mut rcc = Rcc::new();
        rcc.write(offset::CFGR, cfgr::SWS | 1);
        assert_eq!(rcc.read(offset::CFGR), 1);
    }

    #[test]
    fn low_speed_oscillators_are_ready_when_on() {
        let mut rcc = Rcc::new();
        for register in [offset::BDCR, offset::CSR] {
            rcc.write(register, LSON);
            assert_eq!(rcc.read(register) & LSRDY, LSRDY);
            rcc.write(register, 0);
            assert_eq!(rcc.read(register) & LSRDY, 0);
        }
        rcc.write(offset::BDCR, LSON | 1 << 8 | 1 << 15);
        rcc.reset(ResetCause::Software);
        assert_eq!(rcc.read(offset::BDCR), LSON | LSRDY | 1 << 8 | 1 << 15);
        rcc.write(offset::BDCR, BDRST);
        assert_eq!(rcc.read(offset::BDCR), BDRST);
    }

    #[test]
    fn causes_collect_until_they_are_removed() {
        let mut rcc = Rcc::new();
        rcc.reset(ResetCause::Software);
        assert_eq!(rcc.read(offset::CSR), 0x1e00_0000);
        rcc.write(offset::CSR, csr::RMVF);
        assert_eq!(rcc.read(offset::CSR), 0);
        rcc.reset(ResetCause::Software);
        assert_eq!(rcc.read(offset::CSR), csr::SFTRSTF | csr::PINRSTF);
        rcc.reset(ResetCause::IndependentWatchdog);
        assert_eq!(rcc.read(offset::CSR), csr::SFTRSTF | csr::PINRSTF | csr::IWDGRSTF);
        rcc.reset(ResetCause::PowerOn);
        assert_eq!(rcc.read(offset::CSR), 0x0e00_0000);
    }

    #[test]
    fn a_reset_undoes_the_clocks() {
        let mut rcc = Rcc::new();
        at_168_mhz(&mut rcc);
        rcc.write(offset::APB1ENR, CAN1);
        rcc.write(offset::APB1RSTR, CAN1);
        assert!(rcc.can1_is_clocked() && rcc.can1_is_reset());
        rcc.reset(ResetCause::Pin);
        assert!(!rcc.can1_is_clocked() && !rcc.can1_is_reset());
        assert_eq!(rcc.sysclk_hz(), HSI_HZ);
    }

    #[test]
    fn past_the_last_register_there_is_nothing() {
        let mut rcc = Rcc::new();
        rcc.write(offset::END, u32::MAX);
        assert_eq!(rcc.read(offset::END), 0);
        assert_eq!(rcc.read(SIZE), 0);
    }
}
