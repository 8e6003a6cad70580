use jointbus_protocol::decode::ResponseMatcher;
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse};
use jointbus_protocol::nst::{self, serial};
use jointbus_protocol::{checksum, modbus};

/// More than the longest reply of either protocol.
const SEARCHED: usize = 512;

/// How the reply to a client's burst ends.
#[derive(Debug)]
pub(super) enum ReplyEnd {
    /// With an NST reply.
    Nst(serial::ExpectedResponse, Box<ResponseMatcher<SEARCHED, 1>>),
    /// With a Modbus response.
    Modbus(ExpectedResponse, Box<ResponseMatcher<SEARCHED, 2>>),
    /// The burst is a broadcast: there is no reply.
    Never,
    /// The burst is not one whole request that this module knows: a pause ends its reply.
    Pause,
}

impl ReplyEnd {
    /// How the reply to this burst ends. An NST request is never a Modbus one as well: their lengths differ.
    pub(super) fn of(burst: &[u8]) -> Self {
        if checksum::strip_crc(burst).is_none() {
            return Self::Pause;
        }
        if matches!(burst.first(), Some(&modbus::BROADCAST | &nst::BROADCAST)) {
            return Self::Never;
        }
        if let Some(frame) = serial::Frame::decode(burst)
            && let Ok(request) = nst::Request::decode(frame.body)
        {
            return Self::Nst(serial::ExpectedResponse::new(frame.address, &request), Box::default());
        }
        if let Ok(frame) = rtu::Frame::decode(burst)
            && let Ok(request) = modbus::Request::decode(frame.pdu)
        {
            let expected = ExpectedResponse::new(frame.unit, &request);
            if !expected.is_open() {
                return Self::Modbus(expected, Box::default());
            }
        }
        Self::Pause
    }

    /// Whether the reply ends in these bytes, which follow those given before.
    pub(super) fn is_in(&mut self, mut bytes: &[u8]) -> bool {
        match self {
            Self::Nst(expected, search) => search.feed(expected, &mut bytes).is_some(),
            Self::Modbus(expected, search) => search.feed(expected, &mut bytes).is_some(),
            Self::Never | Self::Pause => false,
        }
    }

    /// Whether the burst is one whole request.
    pub(super) const fn is_known(&self) -> bool {
        !matches!(self, Self::Pause)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jointbus_protocol::modbus::AddressRange;

    #[test]
    fn whole_requests_are_known_and_their_replies_found() {
        let mut buffer = [0; 64];
        let request = serial::encode_request(1, &nst::Request::read(0x0200, 18), &mut buffer).unwrap();
        for cut in 0..request.len() {
            assert!(!ReplyEnd::of(&request[..cut]).is_known());
        }
        let mut end = ReplyEnd::of(request);
        assert!(matches!(end, ReplyEnd::Nst(..)));
        let reply = nst::Response::Data { function: nst::FunctionCode::Read, data: &[7; 18] };
        let reply = serial::encode_reply(1, &reply, &mut buffer).unwrap();
        assert!(!end.is_in(&reply[..10]) && end.is_in(&reply[10..]));

        let coils = modbus::Request::ReadCoils(AddressRange::new(0, 8));
        let request = rtu::encode_request(32, &coils, &mut buffer).unwrap();
        let mut end = ReplyEnd::of(request);
        assert!(matches!(end, ReplyEnd::Modbus(..)));
        let refused = modbus::Response::exception(coils.function(), modbus::ExceptionCode::ServerDeviceBusy);
        assert!(end.is_in(rtu::encode_response(32, &refused, &mut buffer).unwrap()));
    }

    #[test]
    fn broadcasts_and_other_things_are_told_apart() {
        let mut buffer = [0; 64];
        let coil = modbus::Request::WriteSingleCoil { address: 0x0200, value: modbus::COIL_ON };
        let broadcast = rtu::encode_request(0, &coil, &mut buffer).unwrap();
        assert!(matches!(ReplyEnd::of(broadcast), ReplyEnd::Never));
        let function = modbus::FunctionCode::from_code(0x41);
        let open = modbus::Request::Other { function, data: &[1, 2, 3] };
        assert!(!ReplyEnd::of(rtu::encode_request(1, &open, &mut buffer).unwrap()).is_known());
        assert!(!ReplyEnd::of(b"garbage").is_known());
        assert!(!ReplyEnd::of(&[]).is_known());
    }
}
