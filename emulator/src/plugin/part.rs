//! Accesses to a part of a register.

use std::ffi::c_uint;

/// The bytes of a register that an access touches.
#[derive(Clone, Copy)]
pub(super) struct Part {
    pub(super) register: u32,
    shift: u32,
    mask: u32,
}

impl Part {
    pub(super) const fn of(offset: u64, size: c_uint) -> Self {
        let shift = (offset as u32 & 3) * 8;
        Self { register: offset as u32 & !3, shift, mask: u32::MAX >> (32 - 8 * size) << shift }
    }

    pub(super) const fn read(self, whole: u32) -> u32 {
        (whole & self.mask) >> self.shift
    }

    pub(super) const fn write(self, whole: u32, value: u32) -> u32 {
        whole & !self.mask | value << self.shift & self.mask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_registers_are_cut_out_and_put_back() {
        for (offset, size, read, written) in [
            (0x74, 4, 0x1234_5678, 0xaabb_ccdd),
            (0x74, 2, 0x5678, 0x1234_ccdd),
            (0x76, 2, 0x1234, 0xccdd_5678),
            (0x77, 1, 0x12, 0xdd34_5678),
        ] {
            let part = Part::of(offset, size);
            assert_eq!(part.register, 0x74);
            assert_eq!(part.read(0x1234_5678), read);
            assert_eq!(part.write(0x1234_5678, 0xaabb_ccdd), written);
        }
    }
}
