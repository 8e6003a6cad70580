//! A classic CAN frame as a plain value (ISO 11898-1), shared by the NST segmentation, SLCAN and the bridge.

use crate::error::error_text;

/// Identifier of a CAN frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Id {
    /// Base format, 11 bits.
    Standard(u16),
    /// Extended format, 29 bits.
    Extended(u32),
}

/// One classic CAN frame.
///
/// The data length code is kept as it was on the wire: 9 to 15 are legal there and mean eight bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame {
    id: Id,
    remote: bool,
    dlc: u8,
    data: [u8; 8],
}

/// Why a [`Frame`] can't be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// The identifier has more than 11 (base format) or 29 bits (extended format).
    Identifier,
    /// The data is longer than eight bytes, or the data length code above 15.
    Length,
}

impl Frame {
    /// A data frame of up to eight bytes.
    ///
    /// # Errors
    /// [`FrameError`] where identifier or data don't fit a classic CAN frame.
    pub fn data_frame(id: Id, data: &[u8]) -> Result<Self, FrameError> {
        let length = u8::try_from(data.len()).map_err(|_| FrameError::Length)?;
        let mut bytes = [0; 8];
        bytes.get_mut(..data.len()).ok_or(FrameError::Length)?.copy_from_slice(data);
        Self::from_parts(id, false, length, bytes)
    }

    /// A data frame whose identifier and length are known to fit; bytes past the length are 0.
    pub(crate) const fn extended(id: u32, length: u8, data: [u8; 8]) -> Self {
        Self { id: Id::Extended(id), remote: false, dlc: length, data }
    }

    /// A frame from the fields of a controller or an adapter; bytes past the length are set to 0.
    ///
    /// # Errors
    /// [`FrameError`] where the identifier has too many bits or `dlc` is above 15.
    pub fn from_parts(id: Id, remote: bool, dlc: u8, mut data: [u8; 8]) -> Result<Self, FrameError> {
        let fits = match id {
            Id::Standard(id) => id < 1 << 11,
            Id::Extended(id) => id < 1 << 29,
        };
        if !fits {
            return Err(FrameError::Identifier);
        }
        if dlc > 15 {
            return Err(FrameError::Length);
        }
        let used = if remote { 0 } else { usize::from(dlc) };
        data.iter_mut().skip(used).for_each(|byte| *byte = 0);
        Ok(Self { id, remote, dlc, data })
    }

    /// Identifier.
    #[must_use]
    pub const fn id(&self) -> Id {
        self.id
    }

    /// Whether this is a remote transmission request, which carries no data.
    #[must_use]
    pub const fn is_remote(&self) -> bool {
        self.remote
    }

    /// Data length code as on the wire, 0 to 15.
    #[must_use]
    pub const fn dlc(&self) -> u8 {
        self.dlc
    }

    /// Data bytes: at most eight, none for a remote frame.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        let length = if self.remote { 0 } else { usize::from(self.dlc).min(8) };
        self.data.get(..length).unwrap_or(&[])
    }

    /// The eight data bytes as a controller's registers hold them, unused ones 0.
    #[must_use]
    pub const fn payload(&self) -> &[u8; 8] {
        &self.data
    }
}

error_text! {
    FrameError {
        FrameError::Identifier => ("the identifier has too many bits"),
        FrameError::Length => ("more than eight bytes, or a data length code above 15"),
    }
}
