use super::can::{self, Segments};
use super::register::{self, Access, SETTINGS_LENGTH, Values};
use super::{
    ADDRESS_MIN, AXES, BROADCAST, BodyError, FunctionCode, REPLY_DATA_MAX, RESPONSE_HEADER, Request,
    Response, Sample, SignEncoding, serial, stream,
};
use crate::checksum::{self, CRC_LENGTH};
use crate::error::error_text;
use crate::wire::copy;

/// The settings could not be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StoreError;

/// What a DAQ firmware puts behind its dispatcher.
pub trait Hardware {
    /// The present sample before zero points: mN and mN.m, or uV.
    fn sample(&mut self) -> Sample;

    /// The registers 0x0000 to 0x01FF as stored.
    fn settings(&self) -> &[u8; SETTINGS_LENGTH];

    /// Stores them; called once a request, with all of it.
    ///
    /// # Errors
    /// [`StoreError`], and the former ones stay.
    fn store(&mut self, settings: &[u8; SETTINGS_LENGTH]) -> Result<(), StoreError>;
}

/// [`Hardware`] in memory, for tests and simulators.
#[derive(Debug, Clone)]
pub struct RamHardware {
    /// What [`Hardware::sample`] returns.
    pub sample: Sample,
    /// The registers 0x0000 to 0x01FF.
    pub settings: [u8; SETTINGS_LENGTH],
}

impl RamHardware {
    /// A device at `address` with CAN at 1000 kbit/s and both UARTs at 115200 baud; the rest is 0.
    #[must_use]
    pub fn new(address: u8) -> Self {
        let mut settings = [0; SETTINGS_LENGTH];
        put(&mut settings, register::ADDRESS, &[address]);
        put(&mut settings, register::UART1_BAUD, &register::DEFAULT_BAUD.to_le_bytes());
        put(&mut settings, register::CAN_RATE, &1000u32.to_le_bytes());
        put(&mut settings, register::UART2_BAUD, &register::DEFAULT_BAUD.to_le_bytes());
        Self { sample: Sample::default(), settings }
    }
}

impl Hardware for RamHardware {
    fn sample(&mut self) -> Sample {
        self.sample
    }

    fn settings(&self) -> &[u8; SETTINGS_LENGTH] {
        &self.settings
    }

    fn store(&mut self, settings: &[u8; SETTINGS_LENGTH]) -> Result<(), StoreError> {
        self.settings = *settings;
        Ok(())
    }
}

/// Why a device does not do what it is asked; it is silent then, and its owner learns the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Refusal {
    /// The registers don't exist.
    Register,
    /// Nothing to read or write, or more than a reply can hold.
    Length,
    /// A register is read only.
    ReadOnly,
    /// A value is not in its set: address, CAN rate, channel or Ethernet mode.
    Value,
    /// The command has one register and one length, and these are others (4.3.1.7, 4.3.1.8, 4.3.1.11).
    CommandForm,
    /// The store failed.
    Store,
}

/// Why a frame or a transfer is not answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NoResponse {
    /// The CRC is wrong.
    Checksum,
    /// Not a request.
    Malformed(BodyError),
    /// Meant for another address.
    OtherAddress,
    /// A broadcast is never answered; it was carried out, or refused for the reason given.
    Broadcast(Option<Refusal>),
    /// A read by broadcast.
    BroadcastRead,
    /// Refused.
    Refused(Refusal),
    /// The reply does not fit the caller's buffer; what was asked has been done all the same.
    NoSpace,
}

/// Settings that took effect at power-up or restart.
#[derive(Debug, Clone, Copy)]
struct Active {
    address: u8,
    zero: [i32; AXES],
}

/// An NST device: its registers and what requests do to them.
///
/// Settings act after a restart, zero points too (4.1.3 to 4.1.11): a read gives the new value at once, the device
/// goes on with the old one until function code 0x18 or power-up.
#[derive(Debug)]
pub struct Daq<H> {
    hardware: H,
    sign: SignEncoding,
    active: Active,
}

impl<H: Hardware> Daq<H> {
    /// Powers the device up.
    #[must_use]
    pub fn new(hardware: H, sign: SignEncoding) -> Self {
        let active = Active { address: 0, zero: [0; AXES] };
        let mut daq = Self { hardware, sign, active };
        daq.restart();
        daq
    }

    /// Restarts the device: the stored settings take effect.
    pub fn restart(&mut self) {
        let settings = self.hardware.settings();
        let mut zero = [0; AXES];
        for (axis, raw) in zero.iter_mut().zip(get(settings, register::ZERO_POINTS).as_chunks::<4>().0) {
            *axis = self.sign.decode_i32(*raw);
        }
        let address = get(settings, register::ADDRESS).first().copied().unwrap_or(ADDRESS_MIN);
        self.active = Active { address, zero };
    }

    /// The address in use: the one stored when the device last started.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.active.address
    }

    /// What is behind the dispatcher.
    pub const fn hardware(&mut self) -> &mut H {
        &mut self.hardware
    }

    /// The present sample after zero points, as the data registers show it.
    pub fn sample(&mut self) -> Sample {
        let mut sample = self.hardware.sample();
        for (axis, zero) in sample.0.iter_mut().zip(self.active.zero) {
            *axis = axis.saturating_sub(zero);
        }
        sample
    }

    /// Answers a frame of RS232 or RS485 into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_serial<'b>(&mut self, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let serial::Frame { address, body } = serial::Frame::decode(frame).ok_or(NoResponse::Checksum)?;
        let reply = self.serve_around(address, body, (1, CRC_LENGTH), out)?;
        if let Some(first) = reply.first_mut() {
            *first = address;
        }
        checksum::close(reply);
        Ok(reply)
    }

    /// Answers a frame of USB, TCP, or a datagram of UDP into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_stream<'b>(&mut self, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let (address, body) = stream::split(frame).ok_or(NoResponse::Malformed(BodyError::Length))?;
        let reply = self.serve_around(address, body, (1, 0), out)?;
        if let Some(first) = reply.first_mut() {
            *first = address;
        }
        Ok(reply)
    }

    /// Answers a transfer on CAN from node `source` to node `destination`: the frames of the answer, whose body is put
    /// into `buffer`.
    ///
    /// What does not fit one transfer is refused whole: a master asks for it in several (4.2.1.2).
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_can<'b>(
        &mut self,
        source: u8,
        destination: u8,
        body: &[u8],
        buffer: &'b mut [u8; can::TRANSFER_MAX],
    ) -> Result<Segments<'b>, NoResponse> {
        let node = self.active.address;
        let reply =
            self.serve_around(destination, body, (0, 0), buffer).map_err(|silence| match silence {
                NoResponse::NoSpace => NoResponse::Refused(Refusal::Length),
                other => other,
            })?;
        can::segment(node, source, reply).map_err(|can::TransferLength| NoResponse::NoSpace)
    }

    /// Answers the body of a request to `address`, which on CAN is the destination node.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve<'b>(
        &mut self,
        address: u8,
        body: &[u8],
        data: &'b mut [u8],
    ) -> Result<Response<'b>, NoResponse> {
        let request = self.judge(address, body)?;
        let result = self.dispatch(&request, data);
        if address == BROADCAST {
            return Err(NoResponse::Broadcast(result.err()));
        }
        result.map_err(NoResponse::Refused)
    }

    /// Whether a body is a request to this device.
    fn judge<'r>(&self, address: u8, body: &'r [u8]) -> Result<Request<'r>, NoResponse> {
        if address != self.active.address && address != BROADCAST {
            return Err(NoResponse::OtherAddress);
        }
        let request = Request::decode(body).map_err(NoResponse::Malformed)?;
        if address == BROADCAST && request.function().is_read() {
            return Err(NoResponse::BroadcastRead);
        }
        Ok(request)
    }

    /// Answers a body into `out`, with so many bytes before and behind the answer left to the caller. Who can't be
    /// answered is not served.
    fn serve_around<'b>(
        &mut self,
        address: u8,
        body: &[u8],
        (before, behind): (usize, usize),
        out: &'b mut [u8],
    ) -> Result<&'b mut [u8], NoResponse> {
        let request = self.judge(address, body)?;
        if address == BROADCAST {
            return Err(NoResponse::Broadcast(self.carry_out(&request, &mut []).err()));
        }
        let (function, length) = (request.function(), request.length());
        let data_length = if function.is_read() { usize::from(length) } else { 0 };
        let end = before.wrapping_add(RESPONSE_HEADER).wrapping_add(data_length);
        let frame = out.get_mut(..end.wrapping_add(behind)).ok_or(NoResponse::NoSpace)?;
        let reply = frame.get_mut(before..end).ok_or(NoResponse::NoSpace)?;
        let [code, count, data @ ..] = reply else { return Err(NoResponse::NoSpace) };
        (*code, *count) = (function.code(), length);
        self.carry_out(&request, data).map_err(NoResponse::Refused)?;
        Ok(frame)
    }

    /// Judges a request whole, then carries it out whole. What a read reads is put into `data`.
    ///
    /// # Errors
    /// [`Refusal`], and nothing has changed.
    pub fn dispatch<'b>(
        &mut self,
        request: &Request<'_>,
        data: &'b mut [u8],
    ) -> Result<Response<'b>, Refusal> {
        let (function, length) = (request.function(), request.length());
        if !function.is_read() {
            self.carry_out(request, &mut [])?;
            return Ok(Response::Acknowledge { function, length });
        }
        let data = data.get_mut(..usize::from(length)).ok_or(Refusal::Length)?;
        self.carry_out(request, data)?;
        Ok(Response::Data { function, data })
    }

    /// `data` has the length that a read asks for.
    fn carry_out(&mut self, request: &Request<'_>, data: &mut [u8]) -> Result<(), Refusal> {
        let exactly = |register: register::Register| {
            request.register() == register.first && u16::from(request.length()) == register.length
        };
        match *request {
            Request::Write { register, data } => self.write(register, data),
            Request::Command { function: FunctionCode::Read, register, .. } => self.read(register, data),
            Request::Command { function: FunctionCode::Search, register, length } => {
                let wanted = register::IP_ADDRESS.length.saturating_add(register::IP_PORT.length);
                if register != register::IP_ADDRESS.first || u16::from(length) != wanted {
                    return Err(Refusal::CommandForm);
                }
                self.read(register, data)
            }
            Request::Command { function: FunctionCode::SetZero, .. } if exactly(register::ZERO_POINTS) => {
                let sample = self.hardware.sample();
                self.store_zero(sample)
            }
            Request::Command { function: FunctionCode::ClearZero, .. } if exactly(register::ZERO_POINTS) => {
                self.store_zero(Sample::default())
            }
            Request::Command { function: FunctionCode::Restart, register: 0, length: 1 } => {
                self.restart();
                Ok(())
            }
            Request::Command { function: FunctionCode::Connect, .. } => Ok(()),
            Request::Command { .. } => Err(Refusal::CommandForm),
        }
    }

    fn read(&mut self, register: u16, data: &mut [u8]) -> Result<(), Refusal> {
        // a device sends one byte fewer than a master takes
        if data.is_empty() || data.len() >= REPLY_DATA_MAX {
            return Err(Refusal::Length);
        }
        let first = usize::from(register);
        if first.saturating_add(data.len()) > usize::from(register::DATA.last()).saturating_add(1) {
            return Err(Refusal::Register);
        }
        let data = match self.hardware.settings().get(first..) {
            Some(stored @ [_, ..]) => {
                let (settings, measured) = data.split_at_mut(stored.len().min(data.len()));
                copy(stored, settings);
                measured
            }
            _ => data,
        };
        if data.is_empty() {
            return Ok(());
        }
        match data.split_first_chunk_mut() {
            Some((place, zeros)) if first <= SETTINGS_LENGTH => {
                self.sample().encode_into(self.sign, place);
                zeros.iter_mut().for_each(|byte| *byte = 0);
            }
            _ => {
                let sample = self.sample().encode(self.sign);
                let values = sample.iter().copied().skip(first.saturating_sub(SETTINGS_LENGTH));
                let values = values.chain(core::iter::repeat(0));
                data.iter_mut().zip(values).for_each(|(byte, value)| *byte = value);
            }
        }
        Ok(())
    }

    fn write(&mut self, first: u16, data: &[u8]) -> Result<(), Refusal> {
        let length = u16::try_from(data.len()).map_err(|_| Refusal::Length)?;
        let last =
            length.checked_sub(1).ok_or(Refusal::Length)?.checked_add(first).ok_or(Refusal::Register)?;
        if last > register::DATA.last() {
            return Err(Refusal::Register);
        }
        let touched = |register: &register::Register| register.meets(first, last);
        if register::TABLE.iter().filter(|register| touched(register)).any(|it| it.access == Access::Read) {
            return Err(Refusal::ReadOnly);
        }
        let mut settings = *self.hardware.settings();
        let place = settings.iter_mut().skip(usize::from(first));
        place.zip(data).for_each(|(byte, new)| *byte = *new);
        for register in register::TABLE.iter().filter(|register| touched(register)) {
            let fits = match register.values {
                Values::Any => true,
                Values::Between(least, most) => {
                    get(&settings, *register).iter().all(|byte| (least..=most).contains(byte))
                }
                Values::OneOf(known) => known.contains(&get_u32(&settings, *register)),
                Values::OneOfOrDefault(known) => {
                    if !known.contains(&get_u32(&settings, *register)) {
                        put(&mut settings, *register, &register::DEFAULT_BAUD.to_le_bytes());
                    }
                    true
                }
            };
            if !fits {
                return Err(Refusal::Value);
            }
        }
        self.hardware.store(&settings).map_err(|StoreError| Refusal::Store)
    }

    fn store_zero(&mut self, zero: Sample) -> Result<(), Refusal> {
        let mut settings = *self.hardware.settings();
        let place = settings.iter_mut().skip(usize::from(register::ZERO_POINTS.first));
        let raw = zero.0.into_iter().flat_map(|axis| self.sign.encode_i32(axis));
        place.zip(raw).for_each(|(byte, new)| *byte = new);
        self.hardware.store(&settings).map_err(|StoreError| Refusal::Store)
    }
}

fn get(settings: &[u8; SETTINGS_LENGTH], register: register::Register) -> &[u8] {
    settings.get(usize::from(register.first)..=usize::from(register.last())).unwrap_or(&[])
}

fn get_u32(settings: &[u8; SETTINGS_LENGTH], register: register::Register) -> u32 {
    get(settings, register).first_chunk::<4>().map_or(0, |raw| u32::from_le_bytes(*raw))
}

fn put(settings: &mut [u8; SETTINGS_LENGTH], register: register::Register, value: &[u8]) {
    settings.iter_mut().skip(usize::from(register.first)).zip(value).for_each(|(byte, new)| *byte = *new);
}

error_text! {
    StoreError {
        StoreError => ("the settings could not be stored"),
    }
}

error_text! {
    Refusal {
        Refusal::Register => ("the registers don't exist"),
        Refusal::Length => ("nothing, or more than a reply can hold"),
        Refusal::ReadOnly => ("a register is read only"),
        Refusal::Value => ("a value is not in its set"),
        Refusal::CommandForm => ("not the register and length of this command"),
        Refusal::Store => ("the store failed"),
    }
}

error_text! {
    NoResponse {
        NoResponse::Checksum => ("the CRC does not fit"),
        NoResponse::Malformed(error) => ("{error}"),
        NoResponse::OtherAddress => ("for another address"),
        NoResponse::Broadcast(None) => ("a broadcast, carried out"),
        NoResponse::Broadcast(Some(refusal)) => ("a broadcast, refused: {refusal}"),
        NoResponse::BroadcastRead => ("a read by broadcast"),
        NoResponse::Refused(refusal) => ("{refusal}"),
        NoResponse::NoSpace => ("the reply does not fit the buffer"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Writer;
    use std::vec::Vec;

    fn daq() -> Daq<RamHardware> {
        let mut hardware = RamHardware::new(1);
        hardware.sample = Sample([1000, -2000, 3000, -4, 5, -6]);
        Daq::new(hardware, SignEncoding::TwosComplement)
    }

    fn ask(daq: &mut Daq<RamHardware>, body: &[u8]) -> Result<Vec<u8>, NoResponse> {
        let (mut data, mut out) = ([0xEE; REPLY_DATA_MAX], [0xEE; REPLY_DATA_MAX + RESPONSE_HEADER]);
        let reply = daq.serve(daq.address(), body, &mut data)?;
        let mut writer = Writer::new(&mut out);
        reply.encode(&mut writer).unwrap();
        Ok(writer.finish().to_vec())
    }

    fn refused(reason: Refusal) -> Result<Vec<u8>, NoResponse> {
        Err(NoResponse::Refused(reason))
    }

    #[test]
    fn data_is_big_endian_and_followed_by_zeros() {
        let reply = ask(&mut daq(), &[3, 2, 0, 20]).unwrap();
        assert_eq!(reply[..8], [3, 20, 0, 0x03, 0xE8, 0xFF, 0xF8, 0x30]);
        assert_eq!(reply[20..], [0, 0]);
    }

    #[test]
    fn a_read_may_cross_from_settings_into_data() {
        let reply = ask(&mut daq(), &[3, 0x01, 0xFE, 5]).unwrap();
        assert_eq!(reply, [3, 5, 0, 0, 0, 0x03, 0xE8]);
    }

    #[test]
    fn limits_of_reads() {
        let mut daq = daq();
        assert_eq!(ask(&mut daq, &[3, 0, 0, 0]), refused(Refusal::Length));
        assert_eq!(ask(&mut daq, &[3, 0, 0, 249]).unwrap().len(), 251);
        assert_eq!(ask(&mut daq, &[3, 0, 0, 250]), refused(Refusal::Length));
        assert_eq!(ask(&mut daq, &[3, 2, 0xFF, 1]).unwrap(), [3, 1, 0]);
        assert_eq!(ask(&mut daq, &[3, 2, 0xFF, 2]), refused(Refusal::Register));
        assert_eq!(ask(&mut daq, &[3, 0xFF, 0xFF, 2]), refused(Refusal::Register));
    }

    #[test]
    fn settings_act_after_a_restart() {
        let mut daq = daq();
        assert_eq!(ask(&mut daq, &[0x10, 0x01, 0x93, 1, 9]).unwrap(), [0x10, 1]);
        assert_eq!(ask(&mut daq, &[3, 0x01, 0x93, 1]).unwrap(), [3, 1, 9], "a read gives the new value");
        assert_eq!(daq.address(), 1);
        assert_eq!(ask(&mut daq, &[0x12, 0x01, 0xA7, 24]).unwrap(), [0x12, 24]);
        assert_eq!(daq.sample().0[0], 1000, "zero points wait as well");
        assert_eq!(ask(&mut daq, &[0x18, 0, 0, 1]).unwrap(), [0x18, 1]);
        assert_eq!(daq.address(), 9);
        assert_eq!(daq.sample(), Sample::default());
        assert_eq!(ask(&mut daq, &[0x19, 0x01, 0xA7, 24]).unwrap(), [0x19, 24]);
        daq.restart();
        assert_eq!(daq.sample().0[0], 1000);
    }

    #[test]
    fn values_outside_their_set() {
        let mut daq = daq();
        let mut set = |register: u16, data: &[u8]| {
            let [high, low] = register.to_be_bytes();
            let mut body = std::vec![0x10, high, low, data.len() as u8];
            body.extend_from_slice(data);
            ask(&mut daq, &body)
        };
        assert_eq!(set(0x0193, &[0]), refused(Refusal::Value));
        assert_eq!(set(0x0193, &[0x80]), refused(Refusal::Value));
        assert!(set(0x0193, &[0x7F]).is_ok());
        assert_eq!(set(0x01C2, &[2]), refused(Refusal::Value));
        assert_eq!(set(0x01C7, &[2]), refused(Refusal::Value));
        assert_eq!(set(0x0198, &999u32.to_le_bytes()), refused(Refusal::Value));
        assert!(set(0x0198, &500u32.to_le_bytes()).is_ok());
        assert!(set(0x0194, &57_600u32.to_le_bytes()).is_ok());
        assert!(set(0x019C, &460_800u32.to_le_bytes()).is_ok());
        assert!(set(0x019C, &[1]).is_ok(), "a single byte makes the rate unknown");
        assert_eq!(set(0x0173, &[1]), refused(Refusal::ReadOnly));
        assert_eq!(set(0x0172, &[1, 1]), refused(Refusal::ReadOnly));
        assert_eq!(set(0x0200, &[1]), refused(Refusal::ReadOnly));
        assert_eq!(set(0x0300, &[1]), refused(Refusal::Register));
        assert_eq!(set(0x0000, &[]), refused(Refusal::Length));
        assert_eq!(set(0xFFFF, &[1, 1]), refused(Refusal::Register));
        assert_eq!(ask(&mut daq, &[3, 0x01, 0x94, 4]).unwrap(), [3, 4, 0, 0xC2, 1, 0], "115200");
        assert_eq!(ask(&mut daq, &[3, 0x01, 0x98, 4]).unwrap(), [3, 4, 0xF4, 1, 0, 0], "500");
        assert_eq!(ask(&mut daq, &[3, 0x01, 0x9C, 4]).unwrap(), [3, 4, 0, 0xC2, 1, 0], "115200");
    }

    #[test]
    fn commands_have_one_form() {
        let mut daq = daq();
        for body in
            [[0x12, 1, 0xA7, 23], [0x19, 1, 0xA6, 24], [0x18, 0, 0, 2], [0x18, 0, 1, 1], [0x15, 1, 0xA1, 5]]
        {
            assert_eq!(ask(&mut daq, &body), refused(Refusal::CommandForm));
        }
        assert_eq!(ask(&mut daq, &[0x13, 0, 0, 1]).unwrap(), [0x13, 1]);
        assert_eq!(ask(&mut daq, &[0x15, 1, 0xA1, 6]).unwrap(), [0x15, 6, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn a_broadcast_is_carried_out_and_never_answered() {
        let mut daq = daq();
        let mut data = [0; REPLY_DATA_MAX];
        let write = [0x10, 0x01, 0x93, 1, 9];
        assert_eq!(daq.serve(0xFF, &write, &mut data), Err(NoResponse::Broadcast(None)));
        assert_eq!(daq.serve(0xFF, &[3, 1, 0x93, 1], &mut data), Err(NoResponse::BroadcastRead));
        assert_eq!(daq.serve(2, &write, &mut data), Err(NoResponse::OtherAddress));
        daq.restart();
        assert_eq!(daq.address(), 9);
    }

    #[test]
    fn who_cannot_be_answered_is_not_served() {
        let (mut daq, mut frame, mut out) = (daq(), [0; 16], [0; 16]);
        let before = daq.hardware().settings;
        let request = Request::Write { register: register::IP_ADDRESS.first, data: &[10, 0, 0, 1] };
        let frame = serial::encode_request(1, &request, &mut frame).unwrap();
        assert_eq!(daq.serve_serial(frame, &mut out[..4]), Err(NoResponse::NoSpace));
        assert_eq!(daq.serve_stream(&frame[..frame.len() - 2], &mut out[..2]), Err(NoResponse::NoSpace));
        assert_eq!(daq.hardware().settings, before);
        assert_eq!(daq.serve_serial(frame, &mut out[..5]).map(<[u8]>::len), Ok(5));
    }

    #[test]
    fn transfers_on_can_are_answered_up_to_their_longest() {
        let mut daq = daq();
        let mut buffer = [0xEE; can::TRANSFER_MAX];
        let frames = |daq: &mut Daq<RamHardware>, body: &[u8], buffer: &mut _| {
            daq.serve_can(2, 1, body, buffer).map(Iterator::count)
        };
        assert_eq!(frames(&mut daq, &[3, 2, 0, 18], &mut buffer), Ok(3));
        assert_eq!(frames(&mut daq, &[3, 0, 0, 126], &mut buffer), Ok(16));
        assert_eq!(frames(&mut daq, &[3, 0, 0, 127], &mut buffer), Err(NoResponse::Refused(Refusal::Length)));
        assert_eq!(frames(&mut daq, &[0x18, 0, 0, 1], &mut buffer), Ok(1));
        assert_eq!(daq.serve_can(2, 9, &[3, 2, 0, 18], &mut buffer).err(), Some(NoResponse::OtherAddress));
    }

    #[test]
    fn the_printed_serial_frames_are_answered_as_printed() {
        let mut out = [0xEE; serial::RESPONSE_MAX];
        let request = [0x01, 0x12, 0x01, 0xA7, 0x18, 0x37, 0x42];
        assert_eq!(daq().serve_serial(&request, &mut out), Ok(&[0x01, 0x12, 0x18, 0x2C, 0xAA][..]));
        let mut wrong = request;
        wrong[6] ^= 1;
        assert_eq!(daq().serve_serial(&wrong, &mut out), Err(NoResponse::Checksum));
        assert_eq!(daq().serve_stream(&request[..5], &mut out), Ok(&[0x01, 0x12, 0x18][..]));
    }
}
