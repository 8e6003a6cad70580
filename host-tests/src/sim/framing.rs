//! Modbus ASCII on a simulated line, beside devices and a host that know frames with CRC.

use jointbus_protocol::checksum;
use jointbus_protocol::modbus::ascii;

/// The characters of a frame with CRC. One whose CRC is wrong is spelt out whole, with a wrong LRC.
pub(super) fn in_characters(frame: &[u8]) -> Vec<u8> {
    let content = checksum::strip_crc(frame).unwrap_or(frame);
    let content = &content[..content.len().min(ascii::CONTENT_MAX)];
    let mut characters: Vec<u8> = (0..).map_while(|index| ascii::character_at(content, index)).collect();
    if checksum::strip_crc(frame).is_none()
        && let [.., last, _, _] = &mut characters[..]
    {
        *last = if *last == b'0' { b'1' } else { b'0' };
    }
    characters
}

/// The frame with CRC that characters stand for; what is no ASCII frame stays what it is.
pub(super) fn with_crc(characters: &[u8]) -> Vec<u8> {
    let mut content = [0; ascii::CONTENT_MAX + 1];
    match ascii::Frame::decode(characters, &mut content) {
        Ok(frame) => sealed(&frame),
        Err(_) => characters.to_vec(),
    }
}

/// The same out of a frame that was taken apart.
pub(super) fn sealed(frame: &ascii::Frame<'_>) -> Vec<u8> {
    let content = [&[frame.unit][..], frame.pdu].concat();
    [&content[..], &checksum::crc16(&content).to_le_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_go_both_ways_and_broken_ones_stay_broken() {
        let frame = sealed(&ascii::Frame { unit: 2, pdu: &[1, 0, 0, 0, 1] });
        assert_eq!(in_characters(&frame), b":020100000001FC\r\n");
        assert_eq!(with_crc(&in_characters(&frame)), frame);
        let mut broken = frame;
        broken[3] ^= 4;
        let mut content = [0; ascii::CONTENT_MAX + 1];
        let decoded = ascii::Frame::decode(&in_characters(&broken), &mut content).map(|_| ());
        assert_eq!(decoded, Err(ascii::FrameError::Checksum));
    }
}
