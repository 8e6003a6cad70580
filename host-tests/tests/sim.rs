//! A short look at everything that `cargo xtask soak` shows at length.

use jointbus_host_tests::sim::properties::{self, Found};
use jointbus_host_tests::sim::{Fault, Plan, Run, SECONDS};
use jointbus_mcu_bridge::io::serial::Queues;

#[track_caller]
fn holds(found: &Found) {
    assert_eq!(found.violated, 0, "{found:#?}");
}

#[test]
fn no_answer_is_wrong_and_every_request_is_accounted_for() {
    holds(&properties::answers(1..21));
}

#[test]
fn the_service_returns_after_each_kind_of_fault() {
    holds(&properties::service_returns(1..2));
}

#[test]
fn a_dead_device_costs_the_others_little() {
    holds(&properties::a_dead_device_costs_little(1, 10 * SECONDS));
}

#[test]
fn polling_is_on_time() {
    holds(&properties::polling_is_on_time(1, 3 * SECONDS));
}

#[test]
fn a_seed_says_it_all() {
    let run = || Plan::of_seed(9, 300, None).run();
    assert_eq!(run(), run());
    assert_ne!(run(), Plan::of_seed(10, 300, None).run());
}

#[test]
fn a_run_is_recorded_from_all_wires() {
    let mut queues = [Queues::new(), Queues::new(), Queues::new()];
    let mut run = Run::new(Plan::of_seed(2, 50, Some(&[Fault::Noise])), &mut queues);
    run.world.record();
    run.to_the_end();
    let file = run.world.recording().expect("it was recorded").to_vec();
    assert_eq!(file[..4], 0x0A0D_0D0Au32.to_le_bytes(), "a section header of pcapng");
    assert!(file.len() > 50 * 60);
}
