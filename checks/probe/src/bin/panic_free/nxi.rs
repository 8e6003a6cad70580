//! `nxi6201`: registers and the dispatcher.

use jointbus_protocol::nxi6201::{
    CHANNELS, Card, Channel, External, Hardware, OutputRange, RamHardware, Register, STORED_LENGTH, Settings,
};

use crate::modbus::request;
use crate::opaque::{any, buffer, byte, bytes, flag, long, sink, size, word};

pub(crate) fn all() {
    registers();
    let Ok(card) = Card::power_up(RamHardware::default(), &settings());
    dispatcher(card);
    dispatcher(Card::resume(RamHardware::default(), settings()));
    if let Ok(card) = Card::power_up(Anything, &settings()) {
        dispatcher(card);
    }
}

fn range() -> OutputRange {
    OutputRange::from_value(long()).unwrap_or_default()
}

fn register() -> Option<Register> {
    match any(0) {
        0 => Some(Register::Range(size())),
        1 => Some(Register::SetValue(size())),
        2 => Some(Register::Output(size())),
        3 => Some(Register::StartEnable(size())),
        4 => Some(Register::StartRange(size())),
        5 => Some(Register::StartValue(size())),
        6 => Some(Register::External(size())),
        _ => Register::at(word()),
    }
}

fn settings() -> Settings {
    let channel = || Channel {
        range: range(),
        set_value: f32::from_bits(long()),
        output: flag(),
        start_enable: long(),
        start_range: range(),
        start_value: f32::from_bits(long()),
        external: External::from_value(long()).unwrap_or_default(),
    };
    let channels: [Channel; CHANNELS] = core::array::from_fn(|_| channel());
    Settings { channels, can_bit_rate: long(), can_id: long(), keep: flag() }
}

#[inline(never)]
fn registers() {
    let range = range();
    sink((range.value(), range.limit(), range.contains(f32::from_bits(long()))));
    sink(External::from_value(long()).map(External::value));
    let mut settings = settings();
    if let Some(register) = register() {
        sink(settings.read(register));
    }
    sink(settings.after_power_up());
    sink(settings.encode());
    sink(Settings::decode(&any([0; STORED_LENGTH])));
    settings.factory_reset();
    sink(settings);
    sink(Settings::default());
}

/// Hardware that fails when it likes.
struct Anything;

impl Hardware for Anything {
    type Error = ();

    fn commit(&mut self, settings: &Settings) -> Result<(), ()> {
        sink(*settings);
        if flag() { Ok(()) } else { Err(()) }
    }
}

#[inline(never)]
fn dispatcher<H: Hardware>(mut card: Card<H>) {
    while flag() {
        match any(0) {
            0 => sink(*card.settings()),
            1 => sink(card.hardware().commit(&settings()).is_ok()),
            2 => sink(card.external_input(size(), flag()).is_ok()),
            3 => sink(card.outputs_off().is_ok()),
            4 => buffer::<300>(|out| sink(card.serve(byte(), bytes(), out))),
            _ => buffer::<300>(|out| sink(card.dispatch(&request(), out))),
        }
    }
}
