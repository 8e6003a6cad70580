//! Each kind of fault alone, in clean traffic.

use super::{Found, of_seeds};
use crate::sim::fault::Fault;
use crate::sim::trial::Trial;
use std::ops::Range;

/// Each kind of fault raises exactly the counters that [`Fault::raises`] names; and it costs no more service than
/// [`Fault::service`] says.
#[must_use]
pub fn each_fault_alone(seeds: Range<u64>) -> [Found; 2] {
    of_seeds(seeds, |seed| {
        let [mut counters, mut service] = [Found::default(), Found::default()];
        for fault in Fault::ALL {
            let trial = Trial::of(*fault, seed);
            let tell = |found: &mut Found, wrong: &[String]| {
                found.count("faults", 1);
                found.count("transactions around them", trial.transactions);
                for what in wrong {
                    let name = fault.name();
                    found.violation(format!("cargo xtask sim --seed {seed} --alone {name}: {what}"));
                }
            };
            tell(&mut counters, &trial.raised);
            tell(&mut service, &trial.service);
            service.count("of them failed", trial.failed);
        }
        [counters, service]
    })
}
