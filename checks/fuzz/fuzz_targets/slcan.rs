//! SLCAN lines: what decodes means the same when it is encoded and decoded again, and after any bytes a line is read.
#![no_main]

use jointbus_protocol::slcan::{Command, DONE, ENCODED_MAX, Event, LINE_MAX, LineError, LineReader, REFUSED};
use jointbus_protocol::time::Instant;
use libfuzzer_sys::fuzz_target;

const NOW: Instant = Instant::from_micros(0);

fuzz_target!(|data: &[u8]| {
    let mut reader = LineReader::<LINE_MAX>::new();
    let mut rest = data;
    while let Some(event) = reader.feed(&mut rest, NOW) {
        let end = data[data.len() - rest.len() - 1];
        match event {
            Event::Frame(line) => {
                assert!(line.len() <= LINE_MAX && end == DONE);
                let Ok(command) = Command::decode(line) else { continue };
                let mut buffer = [0; ENCODED_MAX];
                let encoded = command.encode(&mut buffer);
                let (end, content) = encoded.split_last().unwrap();
                assert_eq!(*end, DONE);
                assert_eq!(Command::decode(content), Ok(command));
                assert!(content.len() <= line.len(), "a time stamp is all that is dropped");
            }
            Event::Dropped(LineError::Refused) => assert_eq!(end, REFUSED),
            Event::Dropped(LineError::TooLong) => assert_eq!(end, DONE),
        }
    }
    assert!(rest.is_empty());
    let _ = reader.feed(&mut &[DONE][..], NOW);
    assert_eq!(reader.feed(&mut &[b'O', DONE][..], NOW), Some(Event::Frame(&b"O"[..])));
});
