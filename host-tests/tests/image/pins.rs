//! What the board's pins do: driver enables, digital and analog inputs and outputs.

use super::*;
use jointbus::bench::OUTPUTS_UNIT;
use jointbus::client::WordOrder;
use jointbus_mcu_bridge::registers;

/// Pins of the digital inputs and outputs in their order, and channels of the analog inputs.
const INPUTS: [&str; 8] = ["PC0", "PC1", "PC2", "PC3", "PC4", "PC5", "PC8", "PC9"];
const OUTPUTS: [&str; 8] = ["PB5", "PB6", "PB7", "PB13", "PB14", "PB15", "PC10", "PC11"];
const CHANNELS: [u8; 4] = [0, 6, 7, 8];

/// Nanoseconds of a transmission, from the first start bit to the end of the last stop bit.
fn sent(emulator: &Emulator, usart: u8) -> Vec<(u64, u64)> {
    let told = emulator.ask(&format!("sent {usart}")).unwrap();
    told.split_ascii_whitespace()
        .map(|word| {
            let (start, end) = word.split_once('-').unwrap();
            (start.parse().unwrap(), end.parse().unwrap())
        })
        .collect()
}

/// Nanoseconds from each rise of a pin to its fall.
fn pulses(emulator: &Emulator, pin: &str) -> Vec<(u64, u64)> {
    let told = emulator.ask(&format!("changes {pin}")).unwrap();
    let mut changes = told.split_ascii_whitespace().map(|word| {
        let (at, level) = word.split_once(':').unwrap();
        (at.parse().unwrap(), level == "1")
    });
    let mut pulses = Vec::new();
    while let Some((rise, true)) = changes.next() {
        let (fall, level) = changes.next().expect("the driver is off again");
        assert!(!level);
        pulses.push((rise, fall));
    }
    pulses
}

#[test]
fn the_driver_is_on_from_before_the_first_bit_until_after_the_last_stop_bit_and_no_longer() {
    const REQUESTS: usize = 5;
    /// Longest time that the driver may be held: the interrupt's way, far below a bit at any rate.
    const LONGEST_NS: u64 = 5000;
    // the devices seem to take their time, so they get it
    let limits = Limits { read_ms: 60_000, time_to_live_ms: 60_000, ..Limits::GENEROUS };
    let mut bench = Bench::emulated(&counted()).unwrap();
    bench.set_limits(&limits).unwrap();
    let mut client = bench.client().unwrap();
    client.nst(RS485_A_UNIT).sample().unwrap();
    client.modbus(RS485_B_UNIT).read_input_registers(0x0040, 8).unwrap();
    let emulator = emulator(&bench);
    emulator.fault("forget all").unwrap();
    for _ in 0..REQUESTS {
        client.nst(RS485_A_UNIT).sample().unwrap();
        client.modbus(RS485_B_UNIT).read_input_registers(0x0040, 8).unwrap();
    }
    // seven bytes at 115200 baud, eight at 19200, ten bits each
    for (usart, pin, bytes, character) in [(2, "PA1", 7, 86_805), (3, "PB12", 8, 520_833)] {
        let (sent, pulses) = (sent(emulator, usart), pulses(emulator, pin));
        assert_eq!((sent.len(), pulses.len()), (REQUESTS, REQUESTS), "{pin}: one pulse a frame");
        for ((start, end), (rise, fall)) in sent.into_iter().zip(pulses) {
            let (wire, expected) = (end - start, bytes * character);
            assert!(wire.abs_diff(expected) < expected / 100, "{pin}: {wire} ns for {bytes} bytes");
            assert!(rise <= start && fall >= end, "{pin}: {rise} {start} {end} {fall}");
            let held = fall - end;
            assert!(held < LONGEST_NS, "{pin} is held {held} ns after the last stop bit");
        }
    }
}

#[test]
fn analog_outputs_appear_at_the_converter_and_the_pwm() {
    /// Steps of 2.5 V of -5 V to 5 V, and of an output that is off: 4095 steps over the range.
    const VALUE: &str = "3071";
    const OFF: &str = "2047";
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let emulator = emulator(&bench);
    let all = || ["dac 1", "dac 2", "pwm 1", "pwm 2"].map(|place| emulator.ask(place).unwrap());
    let expected = |values: [&str; 4]| {
        let [a, b, c, d] = values;
        [a.to_owned(), b.to_owned(), format!("{c} 4096"), format!("{d} 4096")]
    };
    assert_eq!(all(), expected([OFF; 4]));
    let mut values = [OFF; 4];
    for channel in 0..4 {
        let set = [2.5f32.to_bits(), 1];
        client.modbus(OUTPUTS_UNIT).write_values(4 + 20 * channel, &set, WordOrder::LowFirst).unwrap();
        values[usize::from(channel)] = VALUE;
        until(|| all() == expected(values));
    }
    client.modbus(OUTPUTS_UNIT).write_values(6 + 20, &[0u32], WordOrder::LowFirst).unwrap();
    values[1] = OFF;
    until(|| all() == expected(values));
}

#[test]
fn digital_inputs_and_outputs_are_pins() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let emulator = emulator(&bench);
    let mut inputs = || client.modbus(IO_UNIT).read_input_registers(0x0000, 1).unwrap();
    assert_eq!(inputs(), [0xFF], "what is not connected reads 1");
    for (index, pin) in INPUTS.iter().enumerate() {
        emulator.fault(&format!("pin {pin} 0")).unwrap();
        until(|| inputs() == [0xFF & !(1 << index)]);
        emulator.fault(&format!("pin {pin} z")).unwrap();
    }
    let levels = || OUTPUTS.map(|pin| emulator.ask(&format!("level {pin}")).unwrap());
    assert_eq!(levels(), ["0"; 8]);
    for index in 0..8 {
        client
            .modbus(IO_UNIT)
            .write_coils(0x0200, &std::array::from_fn::<_, 8, _>(|at| at == index))
            .unwrap();
        let expected: [&str; 8] = std::array::from_fn(|at| if at == index { "1" } else { "0" });
        until(|| levels() == expected);
    }
}

#[test]
fn analog_inputs_are_measured_and_told_when_they_cannot_be() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let emulator = emulator(&bench);
    for (channel, value) in CHANNELS.iter().zip([0, 1, 0x800, 0xFFF]) {
        emulator.fault(&format!("adc {channel} {value}")).unwrap();
    }
    // 12 bits over the whole range of 16
    let expected = [0x0000, 0x0010, 0x8008, 0xFFFF];
    until(|| client.modbus(IO_UNIT).read_input_registers(0x0040, 4).is_ok_and(|found| found == expected));
    emulator.fault("adc off").unwrap();
    let failed = ExceptionCode::ServerDeviceFailure;
    until(|| {
        let answer = client.modbus(IO_UNIT).read_input_registers(0x0040, 4);
        matches!(answer, Err(Error::Exception(code)) if code == failed)
    });
    client.modbus(IO_UNIT).read_input_registers(0x0000, 1).unwrap();
    client.modbus(IO_UNIT).write_coil(0x0200, true).unwrap();
    until(|| emulator.ask("level PB5").unwrap() == "1");
    emulator.fault("adc on").unwrap();
    until(|| client.modbus(IO_UNIT).read_input_registers(0x0040, 4).is_ok_and(|found| found == expected));
}

#[test]
fn host_silence_switches_the_pins_off() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let emulator = emulator(&bench);
    client.modbus(IO_UNIT).write_coil(0x0207, true).unwrap();
    client.modbus(OUTPUTS_UNIT).write_values(4, &[5f32.to_bits(), 1], WordOrder::LowFirst).unwrap();
    until(|| emulator.ask("level PC11").unwrap() == "1" && emulator.ask("dac 1").unwrap() == "4095");
    client.modbus(bridge::UNIT).write_register(registers::HOST_SILENCE.address, 300).unwrap();
    until(|| emulator.ask("level PC11").unwrap() == "0" && emulator.ask("dac 1").unwrap() == "2047");
    let set = client.modbus(OUTPUTS_UNIT).read_holding_values::<u32>(4, 2, WordOrder::LowFirst).unwrap();
    assert_eq!(set, [5f32.to_bits(), 0], "the set value stays");
}
