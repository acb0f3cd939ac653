//! Bytes of a file, taken from the front; whatever is not there is an error that names the file.

use std::path::Path;

use crate::error::{Error, Result};

/// The file that errors name.
#[derive(Clone, Copy)]
pub struct Named<'a>(pub &'a Path);

impl Named<'_> {
    pub fn bad(&self, reason: impl Into<String>) -> Error {
        Error::file(self.0, reason)
    }

    /// The error of a file that has fewer bytes than it should.
    pub fn ends_within(&self, what: &str) -> Error {
        self.bad(format!("ends within its {what}; it is truncated: copy or export it again"))
    }
}

#[derive(Clone, Copy)]
pub struct Bytes<'a> {
    left: &'a [u8],
    named: Named<'a>,
}

impl<'a> Bytes<'a> {
    /// All of `bytes`, of the file `named`.
    pub fn new(bytes: &'a [u8], named: &Named<'a>) -> Self {
        Self { left: bytes, named: *named }
    }

    pub fn len(&self) -> usize {
        self.left.len()
    }

    /// The next `count` bytes; errors contain their name.
    pub fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8]> {
        let (taken, left) =
            self.left.split_at_checked(count).ok_or_else(|| self.named.ends_within(what))?;
        self.left = left;
        Ok(taken)
    }

    /// The next `count` records of `stride` bytes.
    pub fn take_rows(&mut self, count: usize, stride: usize, what: &str) -> Result<&'a [u8]> {
        let size = count.checked_mul(stride).ok_or_else(|| self.named.ends_within(what))?;
        self.take(size, what)
    }
}

/// The little-endian u16 at byte `at`; `bytes` must hold it.
pub fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

pub fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

pub fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}

pub fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(u32_at(bytes, at))
}
