//! The image on the emulator: how many instructions the bridge takes for what. The recorder tells of each of them.
//!
//! Arguments: image, emulator plugin, recorder. It prints a line for each figure: subject, what, number, with tabs. With
//! `profile` behind the arguments it prints the lines of source that take most of them instead.

mod code;
mod paced;
mod profile;
mod saturated;
mod trace;

use std::env;
use std::ffi::OsString;
use std::fs;
use std::os::unix::net::UnixListener;
use std::path::PathBuf;
use std::thread;

use anyhow::{Context, Result, anyhow, ensure};
use jointbus::bench::{Bench, CAN_UNIT, RS485_A_UNIT};
use jointbus::client::Client;
use jointbus::emulator::Options;

use crate::code::Code;
use crate::paced::Paced;
use crate::trace::{Counts, Trace};

/// Reads of each sensor.
const READS: usize = 40;

/// What the figures are of.
const SUBJECT: &str = "bridge";

fn main() -> Result<()> {
    let paths: Vec<PathBuf> = env::args_os().skip(1).map(PathBuf::from).collect();
    let [image, plugin, recorder, more @ ..] = paths.as_slice() else {
        return Err(anyhow!("arguments: image, emulator plugin, recorder"));
    };
    let counts = record(image, plugin, recorder)?;
    if more.iter().any(|word| word.as_os_str() == "profile") {
        return profile::show(image, &counts.profiles);
    }
    for port in ["USART1", "USART2"] {
        let received = counts.received_byte.get(port).with_context(|| format!("{port} took no byte"))?;
        show(&format!("received byte, {port}"), received)?;
    }
    for (interrupt, bus) in [("CAN1_RX0", "CAN"), ("USART2", "RS485")] {
        let replies = counts.reply.get(interrupt).with_context(|| format!("no reply came by {interrupt}"))?;
        ensure!(replies.len() >= READS / 2, "only {} replies by {bus} found the loop asleep", replies.len());
        show(&format!("reply from {bus} to host"), replies)?;
    }
    ensure!(
        counts.request.len() >= READS / 2,
        "only {} requests for CAN found the loop asleep",
        counts.request.len()
    );
    show("request from host to CAN", &counts.request)?;
    show("idle turn", &counts.idle_turn)?;
    saturated::show(&counts)
}

/// Prints the median and the most.
fn show(what: &str, counts: &[u64]) -> Result<()> {
    let mut counts = counts.to_vec();
    counts.sort_unstable();
    let median = counts.get(counts.len() / 2).with_context(|| format!("{what}: nothing was counted"))?;
    println!("{SUBJECT}\t{what}\t{median}");
    println!("{SUBJECT}\t{what}, worst\t{}", counts.last().unwrap_or(median));
    Ok(())
}

/// Has the image serve its host.
fn record(image: &PathBuf, plugin: &PathBuf, recorder: &PathBuf) -> Result<Counts> {
    let file = fs::read(image).with_context(|| format!("cannot read {}", image.display()))?;
    let mut trace = Trace::new(Code::of(&file)?);
    let folder = tempfile::tempdir()?;
    let socket = folder.path().join("recorder");
    let listener = UnixListener::bind(&socket)?;
    let follower = thread::spawn(move || -> Result<Counts> {
        let (stream, _) = listener.accept()?;
        trace.read(stream)?;
        Ok(trace.counts)
    });
    let mut argument = OsString::from(recorder);
    argument.push(",socket=");
    argument.push(&socket);
    let mut options = Options::new(image, plugin);
    // time by instructions, so that nothing depends on how fast the host is
    (options.icount, options.skip_idle) = (Some(3), true);
    options.arguments = vec!["-plugin".into(), argument];
    {
        let bench = Bench::emulated(&options)?;
        let patience = bench.patience();
        let mut client = Client::new(Paced(bench.client()?.stream().try_clone()?), patience);
        for unit in [CAN_UNIT, RS485_A_UNIT] {
            for _ in 0..READS {
                client.nst(unit).sample().map_err(|error| anyhow!("unit {unit}: {error:?}"))?;
            }
        }
    }
    follower.join().map_err(|_| anyhow!("the trace could not be followed"))?
}
