//! A short look at everything that `cargo xtask soak` shows at length.

use jointbus_host_tests::sim::properties::{self, Found, Traffic};
use jointbus_host_tests::sim::{Fault, Plan, Run, SECONDS, SimBoard};

#[track_caller]
fn holds(found: &Found) {
    assert_eq!(found.violated, 0, "{found:#?}");
}

#[test]
fn no_answer_is_wrong_and_every_request_is_accounted_for() {
    for (board, seeds) in [(SimBoard::STM32F405, 1..41), (SimBoard::SMALL, 1..21), (SimBoard::LARGE, 1..21)] {
        let found = properties::answers(|_| board, seeds);
        holds(&found);
        assert!(found.counted.iter().any(|(what, count)| what == "answered" && *count > 8000), "{found}");
    }
}

#[test]
fn no_bytes_inside_a_frame_are_executed() {
    for board in SimBoard::ALL {
        holds(&properties::hidden_commands(|_| board, 1..6));
    }
}

#[test]
fn each_kind_of_fault_raises_its_counters_and_no_others() {
    let [counters, _] = properties::each_fault_alone(1..3);
    holds(&counters);
}

#[test]
fn the_service_returns_within_the_bound_of_each_kind_of_fault() {
    let [_, service] = properties::each_fault_alone(3..5);
    holds(&service);
}

#[test]
fn the_page_on_faults_is_the_table_in_the_code() {
    let page = include_str!("../FAULTS.md");
    assert!(page == Fault::table(), "`cargo xtask sim --table` prints what host-tests/FAULTS.md has to be");
}

#[test]
fn a_dead_device_costs_the_others_little() {
    holds(&properties::dead_devices(SimBoard::of_seed, 1..4));
}

#[test]
fn polling_beside_the_host_misses_nothing() {
    for board in [SimBoard::STM32F405, SimBoard::LARGE] {
        holds(&properties::polling_is_on_time(board, 1, 3 * SECONDS, Traffic::Calm));
    }
}

#[test]
fn polling_under_faults_counts_every_period() {
    // on the large board fewer of the faults concern the polled sensor
    for (board, span) in [(SimBoard::STM32F405, 6 * SECONDS), (SimBoard::LARGE, 24 * SECONDS)] {
        holds(&properties::polling_is_on_time(board, 1, span, Traffic::Rough));
    }
}

#[test]
fn a_seed_says_it_all() {
    for board in SimBoard::ALL {
        let run = || Plan::of_seed(board, 9, 300, None).run();
        assert_eq!(run(), run());
        assert_ne!(run(), Plan::of_seed(board, 10, 300, None).run());
    }
}

#[test]
fn a_run_is_recorded_from_all_wires() {
    for board in SimBoard::ALL {
        let mut queues = board.queues();
        let mut run = Run::new(Plan::of_seed(board, 2, 50, Some(&[Fault::Noise])), &mut queues);
        run.world.record();
        run.to_the_end();
        let file = run.world.recording().expect("it was recorded").to_vec();
        assert_eq!(file[..4], 0x0A0D_0D0Au32.to_le_bytes(), "a section header of pcapng");
        assert!(file.len() > 50 * 60);
        let has = |name: &str| file.windows(name.len()).any(|part| part == name.as_bytes());
        assert!(board.description.ports.iter().all(|port| has(port.name)));
    }
}
