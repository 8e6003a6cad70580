//! What can go wrong, each kind by name.

/// Where a fault happens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// On an RS485 line or at a device there.
    Serial,
    /// On a CAN bus or at a device there.
    Can,
    /// On the host's line.
    Host,
}

macro_rules! faults {
    ($($place:ident { $(#[doc = $about:literal] $kind:ident = $name:literal,)+ })+) => {
        /// A kind of fault.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Fault {
            $($(#[doc = $about] $kind,)+)+
        }

        impl Fault {
            /// All kinds.
            pub const ALL: &[Self] = &[$($(Self::$kind,)+)+];

            /// Its name on the command line.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $($(Self::$kind => $name,)+)+ }
            }

            /// What happens, in one line.
            #[must_use]
            pub const fn about(self) -> &'static str {
                match self { $($(Self::$kind => $about.trim_ascii(),)+)+ }
            }

            /// Where it happens.
            #[must_use]
            pub const fn place(self) -> Place {
                match self { $($(Self::$kind => Place::$place,)+)+ }
            }
        }
    };
}

faults! {
    Serial {
        /// A request reaches the devices with one to three wrong bits.
        RequestBits = "request-bits",
        /// A byte of a request is not heard.
        RequestByteLost = "request-byte-lost",
        /// A byte of a request is heard twice.
        RequestByteDoubled = "request-byte-doubled",
        /// The bridge's driver rises late: the first bytes of a request are not heard.
        DriverLate = "driver-late",
        /// The bridge's driver falls late: the answer is destroyed.
        DriverHeld = "driver-held",
        /// A reply has one to three wrong bits.
        ReplyBits = "reply-bits",
        /// A byte of a reply is not heard.
        ReplyByteLost = "reply-byte-lost",
        /// A byte of a reply is heard twice.
        ReplyByteDoubled = "reply-byte-doubled",
        /// A reply ends too early.
        ReplyCut = "reply-cut",
        /// Random bytes come right before a reply.
        NoiseBefore = "noise-before",
        /// Random bytes come right behind a reply.
        NoiseAfter = "noise-after",
        /// A reply comes after one to three times the timeout.
        ReplyLate = "reply-late",
        /// A reply comes twice, one right behind the other.
        ReplyTwice = "reply-twice",
        /// A reply names another unit.
        ReplyOtherUnit = "reply-other-unit",
        /// A reply has another function code.
        ReplyOtherFunction = "reply-other-function",
        /// A reply has another length.
        ReplyOtherLength = "reply-other-length",
        /// A Modbus device answers that it failed, or that it takes its time.
        ReplyException = "reply-exception",
        /// A device answers at another baud rate.
        WrongBaud = "wrong-baud",
        /// Random bytes on an idle line.
        Noise = "noise",
        /// Nobody on the line hears anything for a while.
        LineCut = "line-cut",
        /// A break: a zero byte, and then nothing is heard for a while.
        LineBreak = "line-break",
        /// A device is without power for a while, and comes back.
        DeviceDead = "device-dead",
        /// A device babbles for a while, whatever is asked.
        DeviceBabbles = "device-babbles",
    }
    Can {
        /// A frame has a wrong bit, and is sent again.
        CanBit = "can-bit",
        /// So many bit errors in a row that the bridge's controller goes bus-off.
        CanBusOff = "can-bus-off",
        /// Nobody acknowledges the bridge's frames for a while.
        CanNoAcknowledgement = "can-no-acknowledgement",
        /// The bus is held dominant for a while.
        CanDominant = "can-dominant",
        /// A frame is acknowledged, but its receiver has no room for it.
        CanFrameLost = "can-frame-lost",
        /// A frame of a reply arrives twice.
        CanFrameDoubled = "can-frame-doubled",
        /// Two frames of a reply come in the wrong order.
        CanFramesSwapped = "can-frames-swapped",
        /// A frame of a reply has a wrong counter.
        CanWrongCounter = "can-wrong-counter",
        /// A frame of a reply has a type that no table has.
        CanWrongType = "can-wrong-type",
        /// A frame of a reply is for another node.
        CanWrongDestination = "can-wrong-destination",
        /// Other nodes talk to each other at length.
        CanForeignTraffic = "can-foreign-traffic",
        /// A node that was not asked sends frames of all kinds to the bridge.
        CanForeignFrames = "can-foreign-frames",
        /// A node that was not asked sends transfers to the bridge.
        CanForeignTransfer = "can-foreign-transfer",
        /// Frames in base format.
        CanStandardFrames = "can-standard-frames",
        /// Remote frames, one of them with the identifier of a reply.
        CanRemoteFrames = "can-remote-frames",
        /// A reply's frame has a data length code above eight.
        CanLongCode = "can-long-code",
        /// A reply to a read has function code 0x10, as the manual prints it.
        CanQuirk = "can-quirk",
        /// A reply comes after one to three times the timeout.
        CanReplyLate = "can-reply-late",
        /// A reply comes twice, one right behind the other.
        CanReplyTwice = "can-reply-twice",
        /// A device is without power for a while, and comes back.
        CanDeviceDead = "can-device-dead",
    }
    Host {
        /// A burst of random bytes.
        HostGarbage = "host-garbage",
        /// A request ends too early.
        HostCut = "host-cut",
        /// A short pause inside a request.
        HostShortPause = "host-short-pause",
        /// A pause inside a request that ends the burst.
        HostLongPause = "host-long-pause",
        /// Two requests without anything between them.
        HostGlued = "host-glued",
        /// A request with a wrong CRC.
        HostWrongCrc = "host-wrong-crc",
        /// A request with one to three wrong bits.
        HostBits = "host-bits",
        /// A character of a request without its stop bit, and wrong.
        HostFraming = "host-framing",
        /// A request to a unit that no route serves.
        HostUnknownUnit = "host-unknown-unit",
        /// A request with a function code that is in no table.
        HostUnknownFunction = "host-unknown-function",
        /// More bytes than any frame has.
        HostOverlong = "host-overlong",
        /// A broadcast right behind a few stray bytes.
        HostStrayBroadcast = "host-stray-broadcast",
        /// A good request right behind one to four stray bytes.
        HostStrayBytes = "host-stray-bytes",
        /// A write whose data is a valid command, its own CRC wrong.
        HostHiddenCommand = "host-hidden-command",
        /// A write whose length byte is wrong so that a valid command in its data comes to stand behind a frame.
        HostHiddenBehind = "host-hidden-behind",
    }
}

impl Fault {
    /// The kind of that name.
    #[must_use]
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|fault| fault.name() == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_many_and_each_has_a_name_of_its_own() {
        assert!(Fault::ALL.len() >= 30);
        for fault in Fault::ALL {
            assert_eq!(Fault::of_name(fault.name()), Some(*fault));
            assert!(fault.about().ends_with('.') && !fault.about().starts_with(' '));
        }
    }
}
