//! Device identification: function code 2B with MEI type 0E (6.21).

use crate::codes::code_table;
use crate::decode::FrameLength;
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// MEI type of a device identification.
pub const MEI_TYPE: u8 = 0x0E;

/// Bytes of a response's data unit before its objects.
pub const RESPONSE_HEADER: usize = 7;

/// Longest value of an object: it fills a response alone.
pub const OBJECT_MAX: usize = super::PDU_MAX - RESPONSE_HEADER - 2;

code_table! {
    /// Which objects are asked for: read device ID code.
    ReadDeviceIdCode {
        /// Objects 00 to 02, as a stream
        Basic = 0x01,
        /// Objects 00 to 7F, as a stream
        Regular = 0x02,
        /// Objects 00 to FF, as a stream
        Extended = 0x03,
        /// One object
        Individual = 0x04,
    }
}

impl ReadDeviceIdCode {
    /// The last object of a stream of this category; `None` for individual access and for what is unknown.
    #[must_use]
    pub const fn last_object(self) -> Option<ObjectId> {
        match self {
            Self::Basic => Some(ObjectId::MajorMinorRevision),
            Self::Regular => Some(ObjectId::Unknown(0x7F)),
            Self::Extended => Some(ObjectId::Unknown(0xFF)),
            Self::Individual | Self::Unknown(_) => None,
        }
    }
}

code_table! {
    /// What an object tells. Unknown are the reserved 07 to 7F and the device's own 80 to FF.
    ObjectId {
        /// Vendor name: basic, mandatory
        VendorName = 0x00,
        /// Product code: basic, mandatory
        ProductCode = 0x01,
        /// Major and minor revision: basic, mandatory
        MajorMinorRevision = 0x02,
        /// Vendor's address on the web: regular
        VendorUrl = 0x03,
        /// Product name: regular
        ProductName = 0x04,
        /// Model name: regular
        ModelName = 0x05,
        /// User application name: regular
        UserApplicationName = 0x06,
    }
}

code_table! {
    /// What a device offers.
    ConformityLevel {
        /// Basic, as a stream only
        Basic = 0x01,
        /// Regular, as a stream only
        Regular = 0x02,
        /// Extended, as a stream only
        Extended = 0x03,
        /// Basic, as a stream and one by one
        BasicIndividual = 0x81,
        /// Regular, as a stream and one by one
        RegularIndividual = 0x82,
        /// Extended, as a stream and one by one
        ExtendedIndividual = 0x83,
    }
}

impl ConformityLevel {
    /// Whether objects can be read one by one.
    #[must_use]
    pub const fn is_individual(self) -> bool {
        self.code() & 0x80 != 0
    }

    /// The widest stream that is offered.
    #[must_use]
    pub const fn category(self) -> ReadDeviceIdCode {
        ReadDeviceIdCode::from_code(self.code() & 0x7F)
    }
}

/// A device's answer, without the function code and MEI type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Identification<'a> {
    /// What was asked.
    pub category: ReadDeviceIdCode,
    /// What the device offers.
    pub conformity: ConformityLevel,
    /// The object with which to go on; `None` where this was the last of a stream.
    pub next: Option<ObjectId>,
    /// The objects.
    pub objects: Objects<'a>,
}

impl<'a> Identification<'a> {
    pub(super) fn decode(reader: &mut Reader<'a>) -> Result<Self, Truncated> {
        let [category, conformity, more, next, count] = reader.array()?;
        let next = match more {
            0x00 => None,
            _ => Some(ObjectId::from_code(next)),
        };
        let objects = Objects::decode(count, reader)?;
        Ok(Self {
            category: ReadDeviceIdCode::from_code(category),
            conformity: ConformityLevel::from_code(conformity),
            next,
            objects,
        })
    }

    pub(super) fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u8(MEI_TYPE)?;
        writer.u8(self.category.code())?;
        writer.u8(self.conformity.code())?;
        writer.u8(if self.next.is_some() { 0xFF } else { 0x00 })?;
        writer.u8(self.next.map_or(0, ObjectId::code))?;
        writer.u8(self.objects.count)?;
        writer.slice(self.objects.bytes)
    }
}

/// The objects of a response, in order; complete, for that was checked when they were decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Objects<'a> {
    count: u8,
    bytes: &'a [u8],
}

impl<'a> Objects<'a> {
    /// The objects that fill `bytes`, each as on the wire: id, length, value.
    ///
    /// # Errors
    /// [`Truncated`] where the last one is cut, or there are more than 255.
    pub fn new(bytes: &'a [u8]) -> Result<Self, Truncated> {
        let (mut reader, mut count) = (Reader::new(bytes), 0u8);
        while !reader.rest().is_empty() {
            object(&mut reader)?;
            count = count.checked_add(1).ok_or(Truncated)?;
        }
        Ok(Self { count, bytes })
    }

    fn decode(count: u8, reader: &mut Reader<'a>) -> Result<Self, Truncated> {
        let objects = Self::new(reader.slice(reader.rest().len())?)?;
        if objects.count == count { Ok(objects) } else { Err(Truncated) }
    }

    /// How many there are.
    #[must_use]
    pub const fn count(&self) -> u8 {
        self.count
    }
}

impl<'a> Iterator for Objects<'a> {
    type Item = (ObjectId, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let mut reader = Reader::new(self.bytes);
        let found = object(&mut reader).ok()?;
        *self = Self { count: self.count.saturating_sub(1), bytes: reader.rest() };
        Some(found)
    }
}

fn object<'a>(reader: &mut Reader<'a>) -> Result<(ObjectId, &'a [u8]), Truncated> {
    let [id, length] = reader.array()?;
    Ok((ObjectId::from_code(id), reader.slice(length.into())?))
}

/// Length of a response's data unit that starts with `prefix`, function code and MEI type included.
pub(super) fn response_length(prefix: &[u8]) -> FrameLength {
    let Some(&count) = prefix.get(RESPONSE_HEADER.wrapping_sub(1)) else {
        return FrameLength::AtLeast(RESPONSE_HEADER);
    };
    let mut length = RESPONSE_HEADER;
    for _ in 0..count {
        let Some(size) = prefix.get(length.wrapping_add(1)) else {
            return within_pdu(length.wrapping_add(2), FrameLength::AtLeast);
        };
        length = length.wrapping_add(2).wrapping_add(usize::from(*size));
    }
    within_pdu(length, FrameLength::Exactly)
}

fn within_pdu(length: usize, known: fn(usize) -> FrameLength) -> FrameLength {
    if length > super::PDU_MAX { FrameLength::Impossible } else { known(length) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::Response;
    use std::vec::Vec;

    /// Example of the specification (6.21), shortened: three basic objects.
    const PRINTED: &[u8] = b"\x2B\x0E\x01\x01\x00\x00\x03\x00\x04Comp\x01\x04Prod\x02\x05V2.11";

    #[test]
    fn a_response_is_decoded_and_encoded_again() {
        let Ok(response @ Response::DeviceIdentification(identification)) = Response::decode(PRINTED) else {
            panic!("a device identification")
        };
        assert_eq!(identification.category, ReadDeviceIdCode::Basic);
        assert_eq!(identification.conformity, ConformityLevel::Basic);
        assert_eq!(identification.next, None);
        let objects: Vec<_> = identification.objects.collect();
        assert_eq!(
            objects,
            [
                (ObjectId::VendorName, &b"Comp"[..]),
                (ObjectId::ProductCode, b"Prod"),
                (ObjectId::MajorMinorRevision, b"V2.11"),
            ]
        );
        let mut buffer = [0xEE; 64];
        let mut writer = Writer::new(&mut buffer);
        response.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), PRINTED);
    }

    #[test]
    fn every_cut_and_every_other_count_is_refused() {
        for cut in 2..PRINTED.len() {
            assert!(Response::decode(&PRINTED[..cut]).is_err(), "cut at {cut}");
        }
        for count in (0..=255).filter(|count| *count != 3) {
            let mut pdu = PRINTED.to_vec();
            pdu[6] = count;
            assert!(Response::decode(&pdu).is_err(), "{count} objects");
        }
    }

    #[test]
    fn the_length_is_known_as_soon_as_the_last_object_tells_it() {
        for cut in 0..PRINTED.len() {
            match response_length(&PRINTED[..cut]) {
                FrameLength::AtLeast(more) => assert!(more > cut && more <= PRINTED.len()),
                FrameLength::Exactly(length) => assert_eq!(length, PRINTED.len()),
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(response_length(PRINTED), FrameLength::Exactly(PRINTED.len()));
        assert_eq!(response_length(&[0x2B, 0x0E, 1, 1, 0, 0, 1, 0, 245]), FrameLength::Impossible);
        assert_eq!(response_length(&[0x2B, 0x0E, 1, 1, 0, 0, 1, 0, 244]), FrameLength::Exactly(253));
    }

    #[test]
    fn more_follows_names_the_next_object() {
        let pdu = [0x2B, 0x0E, 3, 0x83, 0xFF, 0x80, 1, 0, 1, 7];
        let Ok(Response::DeviceIdentification(identification)) = Response::decode(&pdu) else { panic!() };
        assert_eq!(identification.next, Some(ObjectId::Unknown(0x80)));
        assert!(identification.conformity.is_individual());
        assert_eq!(identification.conformity.category(), ReadDeviceIdCode::Extended);
    }
}
