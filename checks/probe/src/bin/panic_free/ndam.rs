//! `ndam9010`: registers, the dispatcher of a module, and the station.

use jointbus_protocol::modbus::ascii;
use jointbus_protocol::modbus::server::RegisterWriter;
use jointbus_protocol::ndam9010::register::Area;
use jointbus_protocol::ndam9010::settings::{
    Mode, Parity, RamStorage, STORED_LENGTH, Settings, Storage, StoreError, Text, power_up,
};
use jointbus_protocol::ndam9010::{ChannelError, Layout, Module, RamModule, Station, dispatch};

use crate::modbus::request;
use crate::opaque::{any, buffer, byte, bytes, flag, sink, size, word};

pub(crate) fn all() {
    areas();
    module(&mut RamModule::new(layout()));
    module(&mut Anything);
    stored();
    start(&mut RamStorage(Some(any([0; STORED_LENGTH]))));
    start(&mut AnyStorage);
    station::<1>();
    station::<8>();
}

fn layout() -> Layout {
    Layout { digital_inputs: byte(), digital_outputs: byte(), analog_inputs: byte(), analog_outputs: byte() }
}

#[inline(never)]
fn areas() {
    sink(Area::of_register(word()));
    sink(Area::of_bit(word()));
}

#[inline(never)]
fn stored() {
    let Ok(name) = Text::new(bytes()) else { return };
    sink(name.as_bytes());
    let settings = Settings {
        mode: if flag() { Mode::Rtu } else { Mode::Ascii },
        byte_timeout_ms: word(),
        baud: any(0),
        data_bits: byte(),
        stop_bits: byte(),
        parity: if flag() { Parity::None } else { Parity::Space },
        modules: byte(),
        name,
        password: any(name),
    };
    sink(settings.check());
    sink(settings.encode());
    sink(Settings::default());
    sink(Settings::decode(&any([0; STORED_LENGTH])));
}

/// Storage that holds anything, and that may fail.
struct AnyStorage;

impl Storage for AnyStorage {
    fn load(&mut self) -> Option<[u8; STORED_LENGTH]> {
        flag().then(|| any([0; STORED_LENGTH]))
    }

    fn store(&mut self, settings: &[u8; STORED_LENGTH]) -> Result<(), StoreError> {
        sink(*settings);
        if flag() { Ok(()) } else { Err(StoreError) }
    }
}

#[inline(never)]
fn start(storage: &mut impl Storage) {
    sink(power_up(byte(), storage));
    sink(storage.store(&any([0; STORED_LENGTH])));
    sink(storage.load());
}

/// A module with any channels, which change, and with any faults.
struct Anything;

impl Anything {
    fn or_fault<T>(result: T) -> Result<T, ChannelError> {
        match any(0) {
            0 => Err(ChannelError::Failed),
            1 => Err(ChannelError::Busy),
            _ => Ok(result),
        }
    }
}

impl Module for Anything {
    fn layout(&self) -> Layout {
        layout()
    }

    fn digital_inputs(&mut self) -> Result<u16, ChannelError> {
        Self::or_fault(word())
    }

    fn digital_outputs(&mut self) -> Result<u16, ChannelError> {
        Self::or_fault(word())
    }

    fn set_digital_outputs(&mut self, mask: u16, value: u16) -> Result<(), ChannelError> {
        sink((mask, value));
        Self::or_fault(())
    }

    fn analog_inputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        sink(first);
        values.push(word());
        Self::or_fault(())
    }

    fn analog_outputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        values.extend(core::iter::repeat_with(word));
        sink(first);
        Self::or_fault(())
    }

    fn set_analog_outputs(&mut self, first: u8, values: &[u16]) -> Result<(), ChannelError> {
        sink((first, values));
        Self::or_fault(())
    }
}

#[inline(never)]
fn module(module: &mut impl Module) {
    buffer::<300>(|out| sink(dispatch(module, &request(), out)));
    sink(module.set_analog_outputs(byte(), &[any(0)]));
    buffer::<40>(|data| sink(module.analog_inputs(byte(), &mut RegisterWriter::new(data))));
    buffer::<40>(|data| sink(module.analog_outputs(byte(), &mut RegisterWriter::new(data))));
    let mut values = any([0; 40]);
    if let Some(values) = values.get_mut(..size()) {
        sink(module.set_analog_outputs(byte(), values));
    }
    sink((module.digital_inputs(), module.digital_outputs(), module.set_digital_outputs(word(), word())));
}

#[inline(never)]
fn station<const N: usize>() {
    let modules = core::array::from_fn::<_, N, _>(|_| RamModule::new(layout()));
    let Ok(mut station) = Station::new(modules, byte()) else { return };
    while flag() {
        buffer::<300>(|out| sink(station.serve(bytes(), out)));
        let frame = ascii::Frame { unit: byte(), pdu: bytes() };
        buffer::<600>(|out| sink(station.serve_ascii(&frame, out)));
        sink(station.modules());
    }
}
