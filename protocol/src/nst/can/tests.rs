use super::*;
use std::vec::Vec;

const LIMIT: Duration = Duration::from_millis(10);

fn at(millis: u64) -> Instant {
    Instant::from_micros(millis * 1000)
}

fn frames(source: u8, destination: u8, body: &[u8]) -> Vec<Frame> {
    segment(source, destination, body).unwrap().collect()
}

fn complete<const N: usize>(reassembler: &mut Reassembler<N>, frames: &[Frame]) -> Option<Vec<u8>> {
    let mut result = None;
    for frame in frames {
        if let Some(Outcome::Complete { body, .. }) = reassembler.push(frame, at(1)).outcome {
            assert!(result.replace(body.to_vec()).is_none(), "delivered twice");
        }
    }
    result
}

#[test]
fn every_length_is_cut_and_joined_again() {
    let body: Vec<u8> = (0..128).collect();
    for length in 1..=TRANSFER_MAX {
        let cut = frames(1, 2, &body[..length]);
        assert_eq!(cut.len(), length.div_ceil(8));
        let mut reassembler = Reassembler::<1>::new(2, LIMIT);
        assert_eq!(complete(&mut reassembler, &cut).as_deref(), Some(&body[..length]));
    }
    assert_eq!(segment(1, 2, &[]).err(), Some(TransferLength));
    assert_eq!(segment(1, 2, &[0; 129]).err(), Some(TransferLength));
}

#[test]
fn requests_are_split_into_parts_that_fit_a_transfer() {
    let data = [7; 249];
    for length in 0..=249u8 {
        let write = Request::Write { register: 0x10, data: &data[..length.into()] };
        for request in [Request::read(0x10, length), write] {
            let (mut moved, mut parts) = (0u8, 0);
            while let Some(part) = next_fragment(&request, moved) {
                assert_eq!(part.register(), 0x10 + u16::from(moved));
                assert!(part.length() <= if part.function().is_read() { 126 } else { 124 });
                moved += part.length();
                parts += 1;
                if length == 0 {
                    break;
                }
            }
            assert_eq!((moved, parts <= 3), (length, true));
        }
    }
    let command =
        Request::Command { function: super::super::FunctionCode::SetZero, register: 0, length: 200 };
    assert_eq!(next_fragment(&command, 0), Some(command));
    assert_eq!(next_fragment(&command, 200), None);
}

#[test]
fn identifiers_of_the_printed_read_reply() {
    let ids: Vec<Id> = frames(1, 2, &[0; 20]).iter().map(Frame::id).collect();
    assert_eq!(ids, [0x0001_0220, 0x0001_0241, 0x0001_0282].map(Id::Extended));
}

#[test]
fn any_frame_lost_or_swapped_delivers_nothing() {
    let cut = frames(1, 2, &[7; 40]);
    for lost in 0..cut.len() {
        let mut rest = cut.clone();
        rest.remove(lost);
        let mut reassembler = Reassembler::<1>::new(2, LIMIT);
        assert_eq!(complete(&mut reassembler, &rest), None, "frame {lost} lost");
        assert_eq!(complete(&mut reassembler, &cut), Some(std::vec![7; 40]), "and the next one arrives");
    }
    for first in 0..cut.len() - 1 {
        let mut swapped = cut.clone();
        swapped.swap(first, first + 1);
        assert_eq!(complete(&mut Reassembler::<1>::new(2, LIMIT), &swapped), None);
    }
}

#[test]
fn every_irregularity_has_its_name() {
    let cut = frames(1, 2, &[7; 24]);
    let check = |frames: &[(Frame, u64)], expected: ReassemblyError| {
        let mut reassembler = Reassembler::<1>::new(2, LIMIT);
        let mut last = None;
        for (frame, millis) in frames {
            last = reassembler.push(frame, at(*millis)).error;
        }
        assert_eq!(last, Some(expected));
    };
    let raw = |raw: u32, data: &[u8]| Frame::data_frame(Id::Extended(raw), data).unwrap();
    check(&[(Frame::data_frame(Id::Standard(1), &[1]).unwrap(), 0)], ReassemblyError::NotNst);
    check(&[(raw(0x0101_0210, &[1]), 0)], ReassemblyError::NotNst);
    check(
        &[(Frame::from_parts(Id::Extended(0x0001_0210), true, 1, [0; 8]).unwrap(), 0)],
        ReassemblyError::NotNst,
    );
    check(&[(raw(0x0001_0310, &[1]), 0)], ReassemblyError::OtherDestination);
    check(&[(cut[0], 0), (raw(0x0001_FF41, &[1; 8]), 0)], ReassemblyError::OtherDestination);
    check(&[(cut[0], 0), (raw(0x0001_0231, &[1]), 0)], ReassemblyError::UnknownType);
    check(&[(cut[0], 0), (cut[2], 0)], ReassemblyError::Counter);
    check(&[(raw(0x0001_0211, &[1]), 0)], ReassemblyError::Counter);
    check(&[(cut[1], 0)], ReassemblyError::NoFirst);
    check(&[(raw(0x0001_0210, &[]), 0)], ReassemblyError::Length);
    check(&[(raw(0x0001_0220, &[1; 7]), 0)], ReassemblyError::Length);
    check(&[(cut[0], 0), (cut[1], 11)], ReassemblyError::Late);
    check(&[(cut[0], 0), (cut[0], 1)], ReassemblyError::Restarted);
    check(&[(cut[0], 0), (frames(3, 2, &[9; 20])[0], 1)], ReassemblyError::NoContext);
}

#[test]
fn sources_do_not_disturb_each_other() {
    let (one, other) = (frames(1, 2, &[1; 24]), frames(3, 2, &[3; 24]));
    let mixed: Vec<Frame> = one.iter().zip(&other).flat_map(|(a, b)| [*a, *b]).collect();
    let mut reassembler = Reassembler::<2>::new(2, LIMIT);
    let mut found = Vec::new();
    for frame in &mixed {
        if let Some(Outcome::Complete { source, body, .. }) = reassembler.push(frame, at(0)).outcome {
            found.push((source, body.to_vec()));
        }
    }
    assert_eq!(found, [(1, std::vec![1; 24]), (3, std::vec![3; 24])]);
}

#[test]
fn a_stalled_transfer_gives_its_context_to_another_source() {
    let mut reassembler = Reassembler::<1>::new(2, LIMIT);
    reassembler.push(&frames(1, 2, &[1; 24])[0], at(0));
    let report = reassembler.push(&frames(3, 2, &[3; 5])[0], at(11));
    assert_eq!(report.outcome, Some(Outcome::Complete { source: 3, destination: 2, body: &[3; 5] }));
}

#[test]
fn a_forgotten_transfer_is_not_joined_and_the_others_are() {
    let mut reassembler = Reassembler::<2>::new(2, LIMIT);
    for source in [1, 3] {
        reassembler.push(&frames(source, 2, &[source; 12])[0], at(0));
    }
    reassembler.forget(1);
    let report = reassembler.push(&frames(1, 2, &[1; 12])[1], at(0));
    assert_eq!((report.outcome, report.error), (None, Some(ReassemblyError::NoFirst)));
    let report = reassembler.push(&frames(3, 2, &[3; 12])[1], at(0));
    assert_eq!(report.outcome, Some(Outcome::Complete { source: 3, destination: 2, body: &[3; 12] }));
}

#[test]
fn sixteen_frames_and_no_seventeenth() {
    let mut reassembler = Reassembler::<1>::new(2, LIMIT);
    for counter in 0..16u32 {
        let kind = if counter == 0 { 0x20 } else { 0x40 };
        let id = Id::Extended(0x0001_0200 | kind | counter);
        let report = reassembler.push(&Frame::data_frame(id, &[0; 8]).unwrap(), at(0));
        assert_eq!(report.outcome, Some(Outcome::More));
    }
    let wrapped = Frame::data_frame(Id::Extended(0x0001_0240), &[0; 8]).unwrap();
    assert_eq!(reassembler.push(&wrapped, at(0)).error, Some(ReassemblyError::Counter));
}
