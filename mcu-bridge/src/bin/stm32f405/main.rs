//! The bridge on an STM32F405: ports in, engine, ports out.
//!
//! Interrupts only move bytes and frames between the hardware and bounded queues; the idle loop carries them to the
//! engine and back, feeds the watchdog when every part has advanced, and sleeps until the next interrupt.
#![no_std]
#![no_main]
// RTIC makes the resources public, and their types with them
#![allow(unreachable_pub)]

mod bxcan;
mod clocks;
mod constants;
mod flash;
mod fpu;
mod inputs;
mod memory;
mod outputs;
mod pins;
mod reset;
mod time;
mod uart;
mod watchdog;

#[rtic::app(device = stm32f4xx_hal::pac, peripherals = true)]
mod app {
    use crate::bxcan::{self, BusError, Received};
    use crate::constants::CAN_INCOMING;
    use crate::flash::Sectors;
    use crate::inputs::Inputs;
    use crate::outputs::{self, Outputs};
    use crate::time::{self, Clock};
    use crate::uart::{self, Registers, Uart};
    use crate::watchdog::Watchdog;
    use crate::{clocks, fpu, pins, reset};
    use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
    use heapless::spsc::{Consumer, Producer, Queue};
    use jointbus_mcu_bridge::board::Port;
    use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, Engine, RS485_A, RS485_B, Storage};
    use jointbus_mcu_bridge::engine::{Action, Health, Identity, ResetCause, STORED_LENGTH};
    use jointbus_mcu_bridge::io::serial::{
        MainHalf, RX_CAPACITY, RX_CAPACITY_RESPONSES, UartBuffers, extend_timestamp,
    };
    use jointbus_mcu_bridge::io::store::{Store, Unreadable};
    use jointbus_mcu_bridge::io::watchdog::{Heartbeats, Task};
    use jointbus_protocol::time::Instant;
    use stm32f4xx_hal::pac::{self, CAN1, Interrupt, USART1, USART2, USART3};
    use stm32f4xx_hal::rcc::{Enable, Reset};

    /// What the CAN interrupts count for the main loop.
    #[derive(Default)]
    pub struct CanReports {
        sent: AtomicU32,
        /// When the last of these was acknowledged: the low half of the microseconds since boot.
        sent_micros: AtomicU32,
        transmit_errors: AtomicU32,
        receive_errors: AtomicU32,
        overrun: AtomicBool,
    }

    impl CanReports {
        fn are_there(&self) -> bool {
            self.sent.load(Ordering::Relaxed) > 0
                || self.transmit_errors.load(Ordering::Relaxed) > 0
                || self.receive_errors.load(Ordering::Relaxed) > 0
                || self.overrun.load(Ordering::Relaxed)
        }
    }

    static CAN_REPORTS: CanReports = CanReports {
        sent: AtomicU32::new(0),
        sent_micros: AtomicU32::new(0),
        transmit_errors: AtomicU32::new(0),
        receive_errors: AtomicU32::new(0),
        overrun: AtomicBool::new(false),
    };

    const VERSION: [u16; 3] = [
        number(env!("CARGO_PKG_VERSION_MAJOR")),
        number(env!("CARGO_PKG_VERSION_MINOR")),
        number(env!("CARGO_PKG_VERSION_PATCH")),
    ];

    const fn number(part: &str) -> u16 {
        match u16::from_str_radix(part, 10) {
            Ok(number) => number,
            Err(_) => 0,
        }
    }

    /// The tick has come, and time has passed.
    static TICKED: AtomicBool = AtomicBool::new(false);

    /// A serial port as the main loop has it.
    pub struct Line {
        port: Port,
        queues: MainHalf<'static>,
        interrupt: Interrupt,
        usart: Registers,
        bus_hz: u32,
    }

    /// What the engine asked for and takes more than one turn of the main loop.
    #[derive(Default)]
    struct Todo {
        /// The CAN controller is to give up its frames.
        abort: bool,
        /// A port has not taken all that it is to send.
        output: bool,
        /// The chip is to be reset when the host has its answer.
        reboot: bool,
    }

    #[shared]
    struct Shared {}

    #[local]
    struct Local {
        engine: &'static mut Engine,
        clock: Clock,
        watchdog: Watchdog,
        inputs: Inputs,
        outputs: Outputs,
        lines: [Line; 3],
        uart1: Uart<RX_CAPACITY>,
        uart2: Uart<RX_CAPACITY_RESPONSES>,
        uart3: Uart<RX_CAPACITY_RESPONSES>,
        /// `None` where the controller does not answer.
        can: Option<u32>,
        store: Option<Store<Sectors>>,
        frames_in: Producer<'static, Received>,
        frames: Consumer<'static, Received>,
    }

    #[init(local = [
        place: Storage = Storage::new(),
        host: UartBuffers<RX_CAPACITY> = UartBuffers::new(),
        buses: [UartBuffers<RX_CAPACITY_RESPONSES>; 2] = [UartBuffers::new(), UartBuffers::new()],
        can_queue: Queue<Received, CAN_INCOMING> = Queue::new(),
    ])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let mut device = cx.device;
        let mut core = cx.core;
        fpu::keep_no_registers(&mut core.FPU);
        let mut watchdog = Watchdog::start(device.IWDG);
        let reset_cause = reset::cause(&device.RCC);
        let clocks = clocks::start(&device.RCC, &device.FLASH);
        let rcc = &mut device.RCC;
        time::start(&device.TIM5, &mut core.SYST, rcc, &clocks);
        let mut clock = Clock::default();
        watchdog.stretch();
        let mut store = Store::new(Sectors::new(device.FLASH), 0).ok();
        let engine = make_engine(cx.local.place, reset_cause, clock.now());
        let readable = restore(engine, store.as_mut(), clock.now());
        watchdog.relax();

        pins::start(rcc);
        let outputs = Outputs::start(device.DAC, device.TIM3, rcc);
        let inputs = Inputs::start(device.ADC1, &device.ADC_COMMON, rcc, time::micros());

        USART1::enable(rcc);
        USART1::reset(rcc);
        USART2::enable(rcc);
        USART2::reset(rcc);
        USART3::enable(rcc);
        USART3::reset(rcc);
        let (pclk1, pclk2) = (clocks.pclk1_hz, clocks.pclk2_hz);
        let [second, third] = cx.local.buses;
        let (in1, main1) = cx.local.host.split();
        let ((in2, main2), (in3, main3)) = (second.split(), third.split());
        let line = |port, queues, interrupt, usart, bus_hz| {
            if let Some(config) = engine.port(port) {
                uart::configure(usart, bus_hz, config);
            }
            Line { port, queues, interrupt, usart, bus_hz }
        };
        let (usart1, usart2, usart3) =
            (Registers::of(device.USART1), Registers::of(device.USART2), Registers::of(device.USART3));
        let uart1 = Uart::new(usart1, None, in1);
        let uart2 = Uart::new(usart2, Some(&pins::DRIVER_A), in2);
        let uart3 = Uart::new(usart3, Some(&pins::DRIVER_B), in3);
        let lines = [
            line(Port::HOST, main1, Interrupt::USART1, usart1, pclk2),
            line(RS485_A, main2, Interrupt::USART2, usart2, pclk1),
            line(RS485_B, main3, Interrupt::USART3, usart3, pclk1),
        ];

        CAN1::enable(rcc);
        CAN1::reset(rcc);
        let can = engine
            .port(CAN)
            .is_some_and(|port| bxcan::start(&device.CAN1, pclk1, port.rate, port.node).is_ok())
            .then_some(pclk1);
        let (frames_in, frames) = cx.local.can_queue.split();

        engine.set_health(Health {
            internal_oscillator: !clocks.crystal,
            no_can: can.is_none(),
            defaulted: !readable,
        });

        (
            Shared {},
            Local {
                engine,
                clock,
                watchdog,
                inputs,
                outputs,
                lines,
                uart1,
                uart2,
                uart3,
                can,
                store,
                frames_in,
                frames,
            },
        )
    }

    #[idle(
        local = [engine, clock, watchdog, inputs, outputs, lines, can, store, frames]
    )]
    fn idle(cx: idle::Context) -> ! {
        let local = cx.local;
        let engine: &mut Engine = local.engine;
        // what has advanced since the watchdog was fed
        let ports = BOARD.ports().map(Task::Port);
        let mut heartbeats = Heartbeats::new([Task::Tick, Task::Loop, Task::Inputs].into_iter().chain(ports));
        let mut todo = Todo::default();
        loop {
            let now = local.clock.now();
            // a tick that comes between the two is one of many
            let ticked = TICKED.load(Ordering::Relaxed);
            if ticked {
                TICKED.store(false, Ordering::Relaxed);
                // what no interrupt tells of is looked at once a tick, lest each byte pays for it
                let analog = local.inputs.analog(now.as_micros() as u32);
                engine.units_mut().1.set_inputs(local.inputs.digital(), analog);
                if local.can.is_some() {
                    engine.set_bus_off(CAN, bxcan::is_bus_off(can()), now);
                }
            }
            let mut came = false;
            for line in local.lines.iter_mut() {
                came |= line.queues.drain_rx(engine, line.port, now);
            }
            if local.frames.ready() || CAN_REPORTS.are_there() {
                carry_can_in(engine, local.frames, now);
                came = true;
            }
            if came && !engine.is_idle(now) {
                // a request or a reply is not to wait for what is due beside it
                carry_out(engine, local.lines, local.can.is_some(), &mut todo, now);
            }
            let has_output = todo.output || todo.abort || !engine.is_idle(now);
            while let Some(action) = engine.poll(now) {
                match action {
                    Action::Outputs => {
                        local.outputs.apply(&engine.units().0.settings().channels);
                        outputs::drive_digital(engine.units().1.digital_outputs());
                    }
                    Action::AbortCan(_) => todo.abort = true,
                    Action::RestartCan(_) => restart_can(engine, local.can),
                    Action::Configure(port) => configure(engine, local.lines, local.can, port),
                    Action::Store => {
                        local.watchdog.stretch();
                        let stored = save(engine, local.store.as_mut());
                        local.watchdog.relax();
                        engine.saved(stored);
                    }
                    Action::Reboot => todo.reboot = true,
                }
            }

            if has_output {
                carry_out(engine, local.lines, local.can.is_some(), &mut todo, now);
            }
            if ticked {
                for line in local.lines.iter_mut() {
                    if line.queues.made_progress() {
                        heartbeats.set(Task::Port(line.port));
                    }
                }
                heartbeats.set(Task::Tick);
                heartbeats.set(Task::Inputs);
                heartbeats.set(Task::Port(CAN));
                heartbeats.set(Task::Loop);
                if heartbeats.take_all() {
                    local.watchdog.feed();
                }
                let [host, ..] = &local.lines;
                if todo.reboot && engine.output(host.port).is_empty() && host.queues.is_quiet() {
                    reset::by_command();
                }
            }
            // an interrupt between the look and the sleep ends the sleep at once
            cortex_m::interrupt::free(|_| {
                if local.lines.iter().all(|line| line.queues.is_idle()) && !local.frames.ready() {
                    cortex_m::asm::wfi();
                }
            });
        }
    }

    // three are never inlined: their buffers would stay on the stack of the main loop, 804 bytes more at worst

    #[inline(never)]
    fn make_engine(
        place: &'static mut Storage,
        reset_cause: ResetCause,
        now: Instant,
    ) -> &'static mut Engine {
        let identity = Identity { version: VERSION, reset_cause };
        place.start(identity, now)
    }

    /// Gives the engine what is stored, if anything is; tells whether the store is readable.
    #[inline(never)]
    fn restore(engine: &mut Engine, store: Option<&mut Store<Sectors>>, now: Instant) -> bool {
        let stored = store.map_or(Err(Unreadable), |store| store.load(BOARD));
        if let Ok(Some(settings)) = &stored {
            engine.restore(settings, now);
        }
        stored.is_ok()
    }

    #[inline(never)]
    fn save(engine: &Engine, store: Option<&mut Store<Sectors>>) -> bool {
        let mut settings = [0; STORED_LENGTH];
        engine.encode_settings(&mut settings);
        store.is_some_and(|store| store.save(&settings).is_ok())
    }

    fn configure(engine: &mut Engine, lines: &[Line], can_hz: &mut Option<u32>, port: Port) {
        let Some(config) = engine.port(port) else { return };
        if let Some(line) = lines.iter().find(|line| line.port == port) {
            // the interrupt writes the same registers
            cortex_m::interrupt::free(|_| uart::configure(line.usart, line.bus_hz, config));
        } else if let Some(bus_hz) = *can_hz
            && bxcan::start(can(), bus_hz, config.rate, config.node).is_err()
        {
            *can_hz = None;
            engine.set_health(Health { no_can: true, ..engine.health() });
        }
    }

    fn restart_can(engine: &mut Engine, can_hz: &Option<u32>) {
        if can_hz.is_some() && bxcan::restart(can()).is_err() {
            engine.set_health(Health { no_can: true, ..engine.health() });
        }
    }

    fn carry_can_in(engine: &mut Engine, frames: &mut Consumer<'static, Received>, now: Instant) {
        report_sent(engine, now);
        for _ in 0..CAN_REPORTS.transmit_errors.swap(0, Ordering::Relaxed) {
            engine.transmit_error(CAN);
        }
        for _ in 0..CAN_REPORTS.receive_errors.swap(0, Ordering::Relaxed) {
            engine.receive_error(CAN);
        }
        if CAN_REPORTS.overrun.swap(false, Ordering::Relaxed) {
            engine.overrun(CAN);
        }
        for _ in 0..CAN_INCOMING {
            let Some(received) = frames.dequeue() else { break };
            // once more: a reply counts only after the request that it answers, and both may have come just now
            report_sent(engine, now);
            match received.frame() {
                Some(frame) => engine.receive_frame(CAN, &frame, extend_timestamp(now, received.micros)),
                None => engine.receive_error(CAN),
            }
        }
    }

    /// Tells the engine which frames have been acknowledged.
    fn report_sent(engine: &mut Engine, now: Instant) {
        let at = extend_timestamp(now, CAN_REPORTS.sent_micros.load(Ordering::Relaxed));
        for _ in 0..CAN_REPORTS.sent.swap(0, Ordering::Relaxed) {
            engine.frame_sent(CAN, at);
        }
    }

    /// Hands over what is to be sent.
    fn carry_out(engine: &mut Engine, lines: &mut [Line], has_can: bool, todo: &mut Todo, now: Instant) {
        todo.output = false;
        for line in lines {
            if line.queues.fill_tx(engine, line.port) {
                rtic::pend(line.interrupt);
            }
            todo.output |= !engine.output(line.port).is_empty();
        }
        if has_can {
            carry_can_out(engine, todo, now);
        }
    }

    fn carry_can_out(engine: &mut Engine, todo: &mut Todo, now: Instant) {
        let can = can();
        if todo.abort {
            bxcan::abort(can);
            if bxcan::is_empty(can) && CAN_REPORTS.sent.load(Ordering::Relaxed) == 0 {
                todo.abort = false;
                engine.frames_aborted(CAN, now);
            }
            return;
        }
        while bxcan::has_room(can) {
            let Some(frame) = engine.next_frame(CAN) else { break };
            bxcan::transmit(can, &frame);
        }
    }

    /// The controller's registers. Interrupts and main loop each write registers, or bits that ignore a written 0, of
    /// their own.
    fn can() -> &'static pac::can1::RegisterBlock {
        // SAFETY: the peripheral exists as long as the chip runs; who writes what is told above
        unsafe { &*CAN1::ptr() }
    }

    #[task(binds = SysTick, priority = 4)]
    fn tick(_: tick::Context) {
        if time::tick() {
            TICKED.store(true, Ordering::Relaxed);
        }
    }

    #[task(binds = CAN1_RX0, priority = 3, local = [frames_in])]
    fn can_receive(cx: can_receive::Context) {
        let micros = time::micros();
        if bxcan::overrun(can()) {
            CAN_REPORTS.overrun.store(true, Ordering::Relaxed);
        }
        // the FIFO holds three
        for _ in 0..3 {
            let Some(received) = bxcan::receive(can(), micros) else { break };
            if cx.local.frames_in.enqueue(received).is_err() {
                CAN_REPORTS.overrun.store(true, Ordering::Relaxed);
            }
        }
    }

    #[task(binds = CAN1_TX, priority = 3)]
    fn can_sent(_: can_sent::Context) {
        CAN_REPORTS.sent_micros.store(time::micros(), Ordering::Relaxed);
        CAN_REPORTS.sent.fetch_add(bxcan::completed(can()).sent, Ordering::Relaxed);
    }

    #[task(binds = CAN1_SCE, priority = 3)]
    fn can_error(_: can_error::Context) {
        let counter = match bxcan::error(can()) {
            Some(BusError::Transmit) => &CAN_REPORTS.transmit_errors,
            Some(BusError::Receive) => &CAN_REPORTS.receive_errors,
            None => return,
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }

    #[task(binds = USART1, priority = 2, local = [uart1])]
    fn host(cx: host::Context) {
        cx.local.uart1.on_interrupt();
    }

    #[task(binds = USART2, priority = 2, local = [uart2])]
    fn rs485_a(cx: rs485_a::Context) {
        cx.local.uart2.on_interrupt();
    }

    #[task(binds = USART3, priority = 2, local = [uart3])]
    fn rs485_b(cx: rs485_b::Context) {
        cx.local.uart3.on_interrupt();
    }
}
