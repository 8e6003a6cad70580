//! What is measured: by feature one of four, or nothing.

use crate::Request;

/// Reads as long as any, writes as long as any, single writes, and requests that are refused.
pub(crate) static REQUESTS: &[Request] = &[
    // Modbus, and of these the devices know some
    (&[1, 0x01, 0, 0, 0x07, 0xD0], 0),
    (&[1, 0x02, 0, 0, 0x00, 0x10], 0),
    (&[1, 0x03, 0, 0, 0x00, 0x7D], 0),
    (&[1, 0x04, 0, 0, 0x00, 0x01], 0),
    (&[1, 0x05, 2, 0, 0xFF, 0x00], 0),
    (&[1, 0x06, 0, 0x60, 0x12, 0x34], 0),
    (&[1, 0x0F, 0, 0, 0x07, 0xB0, 246], 246),
    (&[1, 0x0F, 2, 0, 0x00, 0x04, 1], 1),
    (&[1, 0x10, 0, 0, 0x00, 0x7B, 246], 246),
    (&[1, 0x10, 0, 0x60, 0x00, 0x04, 8], 8),
    (&[1, 0x03, 0, 2, 0x00, 0x0C], 0),
    (&[1, 0x10, 0, 2, 0x00, 0x04, 8], 8),
    (&[1, 0x10, 0xF3, 0xE4, 0x00, 0x02, 4, 0, 1, 0, 0], 0),
    (&[1, 0x05, 0, 0, 0x12, 0x34], 0),
    (&[1, 0x41, 0, 0], 0),
    (&[0, 0x06, 0, 0x60, 0x00, 0x01], 0),
    // NST
    (&[1, 0x03, 2, 0, 0x12], 0),
    (&[1, 0x03, 0, 0, 249], 0),
    (&[1, 0x10, 0, 0, 249], 249),
    (&[1, 0x10, 1, 0x93, 12, 1, 0, 0xC2, 1, 0, 0xE8, 3, 0, 0, 0, 8, 7], 0),
    (&[1, 0x12, 1, 0xA7, 24], 0),
    (&[1, 0x18, 0, 0, 1], 0),
];

#[cfg(feature = "server")]
mod chosen {
    use jointbus_protocol::modbus::server::{
        self, Bits, BitsMut, RamTables, Registers, RegistersMut, Server,
    };
    use jointbus_protocol::modbus::{ExceptionCode, Range};

    use crate::Single;

    /// Tables that the longest requests fit; function codes 01 to 06, 0F and 10.
    pub(crate) struct Subject(RamTables<250, 2, 128, 4>);

    static SUBJECT: Single<Subject> = Single::new(Subject(RamTables::new()));

    impl Server for Subject {
        fn read_coils(&mut self, range: Range, bits: BitsMut<'_>) -> Result<(), ExceptionCode> {
            self.0.read_coils(range, bits)
        }

        fn read_discrete_inputs(&mut self, range: Range, bits: BitsMut<'_>) -> Result<(), ExceptionCode> {
            self.0.read_discrete_inputs(range, bits)
        }

        fn read_holding_registers(
            &mut self,
            range: Range,
            registers: RegistersMut<'_>,
        ) -> Result<(), ExceptionCode> {
            self.0.read_holding_registers(range, registers)
        }

        fn read_input_registers(
            &mut self,
            range: Range,
            registers: RegistersMut<'_>,
        ) -> Result<(), ExceptionCode> {
            self.0.read_input_registers(range, registers)
        }

        fn write_coils(&mut self, range: Range, bits: Bits<'_>) -> Result<(), ExceptionCode> {
            self.0.write_coils(range, bits)
        }

        fn write_registers(&mut self, range: Range, values: Registers<'_>) -> Result<(), ExceptionCode> {
            self.0.write_registers(range, values)
        }
    }

    pub(crate) fn new() -> &'static mut Subject {
        SUBJECT.take()
    }

    #[inline(never)]
    pub(crate) fn serve(subject: &mut &'static mut Subject, frame: &[u8], out: &mut [u8]) -> bool {
        server::rtu(*subject, 1, frame, out).is_ok()
    }
}

#[cfg(feature = "nst")]
mod chosen {
    use jointbus_protocol::nst::{Daq, RamHardware, SignEncoding};

    use crate::Single;

    static SUBJECT: Single<Option<Daq<RamHardware>>> = Single::new(None);

    pub(crate) fn new() -> &'static mut Daq<RamHardware> {
        SUBJECT.take().insert(Daq::new(RamHardware::new(1), SignEncoding::TwosComplement))
    }

    #[inline(never)]
    pub(crate) fn serve(subject: &mut &'static mut Daq<RamHardware>, frame: &[u8], out: &mut [u8]) -> bool {
        subject.serve_serial(frame, out).is_ok()
    }
}

#[cfg(feature = "nxi")]
mod chosen {
    use core::convert::Infallible;

    use jointbus_protocol::nxi6201::{Card, Hardware, Settings};

    use crate::Single;

    /// Hardware that keeps nothing.
    pub(crate) struct Outputs;

    impl Hardware for Outputs {
        type Error = Infallible;

        fn commit(&mut self, settings: &Settings) -> Result<(), Infallible> {
            core::hint::black_box(settings);
            Ok(())
        }
    }

    static SUBJECT: Single<Option<Card<Outputs>>> = Single::new(None);

    pub(crate) fn new() -> &'static mut Card<Outputs> {
        let Ok(card) = Card::power_up(Outputs, &Settings::default());
        SUBJECT.take().insert(card)
    }

    #[inline(never)]
    pub(crate) fn serve(subject: &mut &'static mut Card<Outputs>, frame: &[u8], out: &mut [u8]) -> bool {
        subject.serve(1, frame, out).is_ok()
    }
}

#[cfg(feature = "ndam")]
mod chosen {
    use jointbus_protocol::ndam9010::{Layout, RamModule, Station};

    use crate::Single;

    static SUBJECT: Single<Option<Station<RamModule, 1>>> = Single::new(None);

    pub(crate) fn new() -> Option<&'static mut Station<RamModule, 1>> {
        let layout =
            Layout { digital_inputs: 16, digital_outputs: 16, analog_inputs: 16, analog_outputs: 16 };
        let station = Station::new([RamModule::new(layout)], 1).ok()?;
        Some(SUBJECT.take().insert(station))
    }

    #[inline(never)]
    pub(crate) fn serve(
        subject: &mut Option<&'static mut Station<RamModule, 1>>,
        frame: &[u8],
        out: &mut [u8],
    ) -> bool {
        subject.as_mut().is_some_and(|station| station.serve(frame, out).is_ok())
    }
}

#[cfg(not(any(feature = "server", feature = "nst", feature = "nxi", feature = "ndam")))]
mod chosen {
    pub(crate) struct Nothing;

    pub(crate) fn new() -> Nothing {
        Nothing
    }

    /// Does nothing, with the same arguments.
    #[inline(never)]
    pub(crate) fn serve(_: &mut Nothing, frame: &[u8], out: &mut [u8]) -> bool {
        core::hint::black_box((frame, out));
        false
    }
}

pub(crate) use chosen::{new, serve};
