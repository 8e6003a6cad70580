//! The board as firmware, client and fault console see it.

use super::*;

const APB1RSTR: u32 = 0x20;
const APB1ENR: u32 = 0x40;
const CAN1: u32 = 1 << 25;
const MCR: u32 = 0x00;
const MSR: u32 = 0x04;
const BTR: u32 = 0x1c;

/// A controller on the bus at 1 Mbit/s from the 16 MHz of the start, one filter that lets everything in.
fn on_bus() -> Board {
    let mut board = Board::new();
    board.write_rcc(APB1ENR, CAN1);
    board.write_can(MCR, 1);
    board.write_can(BTR, 0x001c_0000);
    board.write_can(0x200, 0x2a1c_0e01);
    board.write_can(0x20c, 1);
    board.write_can(0x21c, 1);
    board.write_can(0x200, 0x2a1c_0e00);
    board.write_can(MCR, 0);
    run(&mut board);
    assert_eq!(board.read_can(MSR) & 3, 0);
    board
}

/// Lets the bus fall silent; the nanoseconds that took.
fn run(board: &mut Board) -> u64 {
    let Some(mut total) = board.idle_ns() else { return 0 };
    while let Some(next) = board.step() {
        total += next;
    }
    total
}

fn transmit(board: &mut Board) {
    board.write_can(0x184, 1);
    board.write_can(0x188, 0xaa);
    board.write_can(0x180, 0x123 << 21 | 1);
}

#[test]
fn frames_take_their_time() {
    let mut board = on_bus();
    transmit(&mut board);
    assert_eq!(run(&mut board), (11 + 47 + 8) * 1000);
    assert_eq!(board.can_output(), b"t1231AA\r");
}

#[test]
fn a_clients_frame_is_confirmed_and_stored() {
    let mut board = on_bus();
    board.take_can_bytes(b"T000000012BEEF\rr0014\r");
    run(&mut board);
    assert_eq!(board.can_output(), b"Z\rz\r");
    assert_eq!(board.read_can(0x0c) & 3, 2);
    assert_eq!(board.read_can(0x1b0), 1 << 3 | 4);
    assert_eq!(board.read_can(0x1b8), 0xefbe);
}

#[test]
fn a_frame_that_nobody_hears_is_refused() {
    let mut board = Board::new();
    board.take_can_bytes(b"t1230\r");
    run(&mut board);
    assert_eq!(board.can_output(), [7]);
}

#[test]
fn a_wrong_bit_rate_is_noticed() {
    let mut board = on_bus();
    board.take_can_bytes(b"S6\rt1230\r");
    run(&mut board);
    assert_eq!(board.can_output(), b"\r\x07");
    board.take_can_bytes(b"S8\rt1230\r");
    run(&mut board);
    assert_eq!(board.can_output(), b"\rz\r");
    board.take_can_bytes(b"S6\r");
    board.can_client_connected();
    board.take_can_bytes(b"t1230\r");
    run(&mut board);
    assert_eq!(board.can_output(), b"z\r");
}

#[test]
fn never_more_is_accepted_than_fits() {
    let mut board = on_bus();
    board.take_console_bytes(b"room 0\n");
    let room = board.can_room();
    let line = b"t1230\r";
    board.take_can_bytes(&line[..5]);
    board.take_can_bytes(&b"\rt1230".repeat(room / 6));
    assert_eq!(board.can_room(), 0);
    board.take_can_bytes(b"\r");
    run(&mut board);
    assert_eq!(board.can_output(), b"z\r".repeat(room / 6 + 1));
}

#[test]
fn the_clock_gates_the_controller() {
    let mut board = Board::new();
    board.write_can(MCR, 1);
    assert_eq!(board.read_can(MSR), 0);
    board.write_rcc(APB1ENR, CAN1);
    assert_eq!(board.read_can(MSR), 0xc02);
}

#[test]
fn the_reset_bit_resets_the_controller() {
    let mut board = on_bus();
    board.write_rcc(APB1RSTR, CAN1);
    board.write_can(MCR, 1);
    board.write_rcc(APB1RSTR, 0);
    assert_eq!(board.read_can(MCR), 0x0001_0002);
}

#[test]
fn a_reset_ends_the_frame_on_the_wire() {
    let mut board = on_bus();
    transmit(&mut board);
    assert!(board.step().is_some());
    board.reset(0);
    assert_eq!(board.read_rcc(0x74), 0x1e00_0000);
    run(&mut board);
    assert_eq!(board.can_output(), b"");
}

#[test]
fn faults_are_injected_by_name() {
    let mut board = on_bus();
    board.take_console_bytes(b"bus 0\r\nack 0\n\nwhat\n");
    assert_eq!(board.console_output(), b"ok\nok\n?\n");
    transmit(&mut board);
    assert_eq!(board.idle_ns(), None);
    board.take_console_bytes(b"bus 1\n");
    board.step();
    board.step();
    assert_eq!(board.read_can(0x18) >> 16 & 0xff, 8);
    board.take_console_bytes(b"ack 1\n");
    run(&mut board);
    assert_eq!(board.can_output(), b"t1231AA\r");
    board.take_console_bytes(b"cause iwdg\n");
    board.reset(0);
    assert_eq!(board.read_rcc(0x74), 0x2e00_0000);
}

#[test]
fn the_power_goes_with_the_change_that_was_asked_for() {
    let mut board = Board::new();
    assert!(!board.power_goes());
    board.take_console_bytes(b"cut 2\n");
    assert_eq!([board.power_goes(), board.power_goes()], [false, true]);
}

#[test]
fn a_byte_gets_onto_the_line_only_while_its_driver_is_enabled() {
    for (enabled, expected) in [(false, &[][..]), (true, &[0x55])] {
        let mut board = Board::new();
        board.gpio().write(0, 0x00, 1 << 2, 0);
        board.gpio().write(0, 0x14, u32::from(enabled) << 1, 5);
        let (usart, hz) = board.usart(0);
        usart.write(0x08, 16, 0, hz);
        usart.write(0x0c, 1 << 13 | 1 << 3, 0, hz);
        usart.write(0x04, 0x55, 10, hz);
        assert_eq!(board.step_usart(0, 20_000), expected);
        board.take_console_bytes(b"changes PA1\nsent 2\nlevel PB0\n");
        let changes = if enabled { "0:0 5:1" } else { "0:0" };
        let told = format!("ok {changes}\nok 10-10010\nok z\n");
        assert_eq!(String::from_utf8(board.console_output()).unwrap(), told);
    }
}
