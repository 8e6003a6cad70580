use super::*;
use crate::time::{Duration, Instant};
use std::vec::Vec;

/// `[length, …, sum]`: a toy with all that a format can say; length 0 ends by silence, above 8 is impossible.
struct Toy;

impl Framing for Toy {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        match prefix[0] {
            0 => FrameLength::UntilSilence,
            1 if prefix.len() < 3 => FrameLength::AtLeast(3),
            1 => FrameLength::Exactly(3 + usize::from(prefix[2])),
            length @ 2..=8 => FrameLength::Exactly(length.into()),
            _ => FrameLength::Impossible,
        }
    }
    fn is_valid(&self, frame: &[u8]) -> bool {
        let (sum, content) = frame.split_last().unwrap();
        content.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)) == *sum
    }
    fn is_broadcast(&self, frame: &[u8]) -> bool {
        frame.get(1) == Some(&0xFF)
    }
}

const SILENCE: Duration = Duration::from_millis(20);

#[derive(Debug, PartialEq)]
enum Out {
    Frame(Vec<u8>),
    Dropped(DecodeError),
}

fn out(event: FrameEvent<'_>) -> Out {
    match event {
        Event::Frame(frame) => Out::Frame(frame.into()),
        Event::Dropped(Dropped { error, .. }) => Out::Dropped(error),
    }
}

/// Feeds each burst in pieces of every size, and a silence after it.
fn run(bursts: &[&[u8]]) -> Vec<Out> {
    let mut results: Vec<Vec<Out>> = Vec::new();
    for piece in 1..=12 {
        let mut decoder = FrameDecoder::<12>::new(SILENCE);
        let (mut now, mut found) = (Instant::from_micros(5), Vec::new());
        for burst in bursts {
            for mut chunk in burst.chunks(piece) {
                while let Some(event) = decoder.feed(&Toy, &mut chunk, now) {
                    found.push(out(event));
                }
                assert!(chunk.is_empty());
                now = now.saturating_add(Duration::from_millis(1));
            }
            now = now.saturating_add(SILENCE);
            found.extend(decoder.poll(&Toy, now).map(out));
            assert_eq!(decoder.deadline(), None);
        }
        results.push(found);
    }
    assert!(results.iter().all(|found| *found == results[0]), "pieces change the outcome: {results:?}");
    results.remove(0)
}

#[test]
fn frames_back_to_back_are_taken_without_silence() {
    assert_eq!(
        run(&[&[3, 1, 4, 4, 9, 9, 22, 1, 7, 2, 5, 15]]),
        [Out::Frame([3, 1, 4].into()), Out::Frame([4, 9, 9, 22].into()), Out::Frame([1, 7, 2, 5, 15].into())]
    );
}

#[test]
fn after_a_wrong_frame_nothing_is_taken_until_silence() {
    assert_eq!(
        run(&[&[3, 1, 5, 3, 1, 4, 3, 1, 4], &[3, 1, 4]]),
        [Out::Dropped(DecodeError::Checksum), Out::Frame([3, 1, 4].into())]
    );
    assert_eq!(run(&[&[99, 1, 2, 3, 9, 3, 1, 4]]), [Out::Dropped(DecodeError::Impossible)]);
    assert_eq!(run(&[&[8, 3, 1, 4]]), [Out::Frame([3, 1, 4].into())], "one stray byte in front");
    assert_eq!(run(&[&[8, 9, 9, 9, 9, 3, 1]]), [Out::Dropped(DecodeError::Incomplete)]);
}

#[test]
fn stray_bytes_in_front_are_forgiven_up_to_four_and_never_for_a_broadcast() {
    for stray in 1..=6 {
        let mut burst = std::vec![200; stray];
        burst.extend([3, 1, 4]);
        let expected = match stray {
            ..=STRAY_MAX => Out::Frame([3, 1, 4].into()),
            _ => Out::Dropped(DecodeError::Impossible),
        };
        assert_eq!(run(&[&burst]), [expected], "{stray} stray bytes");
    }
    assert_eq!(run(&[&[200, 3, 0xFF, 2]]), [Out::Dropped(DecodeError::Impossible)]);
    assert_eq!(run(&[&[3, 0xFF, 2]]), [Out::Frame([3, 0xFF, 2].into())]);
    assert_eq!(
        run(&[&[200, 3, 1, 4, 7]]),
        [Out::Dropped(DecodeError::Impossible)],
        "does not fill the burst"
    );
}

#[test]
fn silence_ends_what_has_no_length_of_its_own() {
    assert_eq!(run(&[&[0, 5, 5, 10]]), [Out::Frame([0, 5, 5, 10].into())]);
    assert_eq!(run(&[&[0, 5, 5, 11]]), [Out::Dropped(DecodeError::Checksum)]);
    assert_eq!(run(&[&[200, 0, 5, 5, 10]]), [Out::Frame([0, 5, 5, 10].into())]);
}

#[test]
fn an_endless_burst_is_bounded_and_dropped_once() {
    let noise = [0x55; 300];
    assert_eq!(
        run(&[&noise, &[3, 1, 4]]),
        [Out::Dropped(DecodeError::Impossible), Out::Frame([3, 1, 4].into())]
    );
    let mut open = [1; 300];
    open[0] = 0;
    assert_eq!(run(&[&open]), [Out::Dropped(DecodeError::Checksum)]);
    assert_eq!(run(&[&[1, 0, 250, 9]]), [Out::Dropped(DecodeError::Impossible)], "longer than the buffer");
}

#[test]
fn silence_is_noticed_by_the_next_byte_as_well() {
    let mut decoder = FrameDecoder::<12>::new(SILENCE);
    let start = Instant::from_micros(0);
    assert_eq!(decoder.feed(&Toy, &mut &[3, 1][..], start), None);
    let mut next = &[3, 1, 4][..];
    let later = start.saturating_add(SILENCE);
    assert_eq!(decoder.feed(&Toy, &mut next, later).map(out), Some(Out::Dropped(DecodeError::Incomplete)));
    assert_eq!(next.len(), 3, "the new burst is still to be fed");
    assert_eq!(decoder.feed(&Toy, &mut next, later).map(out), Some(Out::Frame([3, 1, 4].into())));
}

struct Reply;

impl Match<2> for Reply {
    fn lengths(&self) -> [usize; 2] {
        [6, 3]
    }
    fn accepts(&self, kind: usize, frame: &[u8]) -> bool {
        assert_eq!(frame.len(), self.lengths()[kind]);
        frame[0] == 7 && Toy.is_valid(frame)
    }
}

#[test]
fn a_reply_that_was_begun_is_found_though_the_kinds_change() {
    /// First waits for a reply of three bytes, then in the same place for one of six.
    struct One(usize);
    impl Match<1> for One {
        fn lengths(&self) -> [usize; 1] {
            [self.0]
        }
        fn accepts(&self, _: usize, frame: &[u8]) -> bool {
            frame[0] == 7 && frame.len() == 6
        }
    }
    let mut search = ResponseMatcher::<16, 1>::default();
    assert_eq!(search.feed(&One(3), &mut &[7, 1, 1, 1][..]), None);
    search.rescan();
    assert_eq!(search.feed(&One(6), &mut &[1, 11][..]), Some((0, &[7, 1, 1, 1, 1, 11][..])));
}

#[test]
fn the_reply_is_found_behind_noise_of_any_length() {
    for (kind, reply, noise) in [(0, &[7, 1, 1, 1, 1, 11][..], 7), (1, &[7, 2, 9], 7), (1, &[7, 2, 9], 1)] {
        for length in (0..40).step_by(crate::stride(7)) {
            let mut search = ResponseMatcher::<16, 2>::default();
            let mut stream = std::vec![noise; length];
            stream.extend_from_slice(reply);
            stream.push(77);
            let mut rest = &stream[..];
            assert_eq!(search.feed(&Reply, &mut rest), Some((kind, reply)), "{length} bytes of noise");
            assert_eq!(rest, [77]);
            assert!(!search.has_leftovers());
            assert_eq!(search.feed(&Reply, &mut rest), None);
            assert!(search.has_leftovers());
        }
    }
}

#[test]
fn a_reply_of_unknown_length_ends_at_silence() {
    let mut search = ResponseMatcher::<16, 2>::default();
    assert_eq!(search.feed(&Reply, &mut &[1, 2, 7, 5, 5, 17][..]), None);
    let accepts = |frame: &[u8]| frame[0] == 7 && frame.len() > 2 && Toy.is_valid(frame);
    assert_eq!(search.end_of_frame(accepts), Some(&[7, 5, 5, 17][..]));
}
