//! SLCAN lines: what decodes means the same when it is encoded and decoded again, and after any bytes a line is read.
#![no_main]

use jointbus_protocol::slcan::{Command, DONE, ENCODED_MAX, LINE_MAX, LineReader, Outcome, REFUSED};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut reader = LineReader::<LINE_MAX>::new();
    for byte in data {
        let Some(outcome) = reader.push(*byte) else { continue };
        match outcome {
            Outcome::Line(line) => {
                assert!(line.len() <= LINE_MAX && *byte == DONE);
                let Ok(command) = Command::decode(line) else { continue };
                let mut buffer = [0; ENCODED_MAX];
                let encoded = command.encode(&mut buffer);
                let (end, content) = encoded.split_last().unwrap();
                assert_eq!(*end, DONE);
                assert_eq!(Command::decode(content), Ok(command));
                assert!(content.len() <= line.len(), "a time stamp is all that is dropped");
            }
            Outcome::Refused => assert_eq!(*byte, REFUSED),
            Outcome::TooLong => assert_eq!(*byte, DONE),
        }
    }
    reader.push(DONE);
    reader.push(b'O');
    assert_eq!(reader.push(DONE), Some(Outcome::Line(b"O")));
});
