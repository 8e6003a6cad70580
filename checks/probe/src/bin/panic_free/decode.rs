//! `decode`, with formats and expectations that answer anything.

use jointbus_protocol::decode::{FrameDecoder, FrameLength, Framing, Match, ResponseMatcher};

use crate::opaque::{any, bytes, flag, moment, sink, size, span};

pub(crate) fn all() {
    burst::<0>();
    burst::<1>();
    burst::<260>();
    search::<0, 0>();
    search::<1, 1>();
    search::<300, 2>();
}

/// Says anything about any frame.
struct Anything;

impl Framing for Anything {
    fn length(&self, _: &[u8]) -> FrameLength {
        match any(0) {
            0 => FrameLength::Exactly(size()),
            1 => FrameLength::AtLeast(size()),
            2 => FrameLength::UntilSilence,
            _ => FrameLength::Impossible,
        }
    }

    fn is_valid(&self, _: &[u8]) -> bool {
        flag()
    }

    fn is_broadcast(&self, _: &[u8]) -> bool {
        flag()
    }

    fn forgives_stray_bytes(&self) -> bool {
        flag()
    }
}

impl<const L: usize> Match<L> for Anything {
    fn lengths(&self) -> [usize; L] {
        core::array::from_fn(|_| size())
    }

    fn accepts(&self, _: usize, _: &[u8]) -> bool {
        flag()
    }
}

/// Any order of calls, for as long as it takes.
#[inline(never)]
fn burst<const N: usize>() {
    let mut decoder = FrameDecoder::<N>::new(span());
    while flag() {
        let mut some = bytes();
        match any(0) {
            0 => sink(decoder.feed(&Anything, &mut some, moment())),
            1 => sink(decoder.poll(&Anything, moment())),
            2 => sink(decoder.deadline()),
            _ => decoder.set_silence(span()),
        }
        sink(some);
    }
}

#[inline(never)]
fn search<const N: usize, const L: usize>() {
    let mut search = if flag() { ResponseMatcher::<N, L>::default() } else { ResponseMatcher::new() };
    while flag() {
        let mut some = bytes();
        match any(0) {
            0 => sink(search.feed(&Anything, &mut some)),
            1 => sink(search.end_of_frame(|_| flag())),
            2 => sink(search.has_leftovers()),
            3 => search.rescan(),
            _ => search.clear(),
        }
        sink(some);
    }
}
