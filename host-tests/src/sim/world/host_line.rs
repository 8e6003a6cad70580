//! The line between the host and the bridge.

use super::{Event, Notice, ToSend, World, micros};
use jointbus_mcu_bridge::board::Port;

impl World<'_> {
    pub(super) fn host_goes_on(&mut self) {
        if self.host_sending {
            return;
        }
        match self.to_bridge.front() {
            Some(ToSend::Byte(_) | ToSend::Unframed(_)) => {
                self.host_sending = true;
                self.agenda.enter(self.now.saturating_add(self.host_byte), Event::ToBridge);
            }
            Some(ToSend::Pause(span)) => {
                self.host_sending = true;
                let end = self.now.saturating_add(*span);
                self.to_bridge.pop_front();
                self.agenda.enter(end, Event::HostGoesOn);
            }
            None => {}
        }
    }

    pub(super) fn end_byte_to_bridge(&mut self) {
        let sent = self.to_bridge.pop_front();
        if let Some(ToSend::Unframed(_)) = sent {
            self.firmware.on_framing_error(Port::HOST);
        }
        if let Some(ToSend::Byte(byte) | ToSend::Unframed(byte)) = sent {
            self.uarts[0].queues.received(byte, micros(self.now));
            self.interrupt();
        }
        self.host_sending = false;
        self.host_goes_on();
    }

    pub(super) fn start_byte_to_host(&mut self) {
        self.to_host = self.uarts[0].queues.transmitter().next_byte();
        self.uarts[0].sending = self.to_host.is_some();
        if self.to_host.is_some() {
            self.agenda.enter(self.now.saturating_add(self.host_byte), Event::ToHost);
        }
    }

    pub(super) fn end_byte_to_host(&mut self) {
        if let Some(byte) = self.to_host.take() {
            self.notices.push_back(Notice::HostHears(byte));
            if let Some(recorder) = &mut self.recorder {
                recorder.bytes(Port::HOST, false, self.now, &[byte]);
            }
        }
        self.start_byte_to_host();
        // room in the queue, or the end of a transmission
        if !self.uarts[0].sending {
            self.uarts[0].queues.transmitter().transmitted(micros(self.now));
            self.interrupt();
        }
    }
}
