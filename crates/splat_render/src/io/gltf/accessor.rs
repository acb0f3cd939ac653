//! Accessors: typed rows of numbers in a buffer.

use serde_json::Value;

use super::document::{Document, number};
use crate::error::Result;
use crate::io::bytes::{f32_at, u16_at};
use crate::io::limits::SPLATS_MAX;

/// Component types: bytes, and the number and the unit of a normalized one at a byte.
#[derive(Clone, Copy)]
enum Component {
    Byte,
    UnsignedByte,
    Short,
    UnsignedShort,
    Float,
}

impl Component {
    fn of(code: u64) -> Option<Self> {
        Some(match code {
            5120 => Self::Byte,
            5121 => Self::UnsignedByte,
            5122 => Self::Short,
            5123 => Self::UnsignedShort,
            super::FLOAT => Self::Float,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::Byte | Self::UnsignedByte => 1,
            Self::Short | Self::UnsignedShort => 2,
            Self::Float => 4,
        }
    }

    fn read(self, bytes: &[u8], at: usize, normalized: bool) -> f32 {
        let (value, top) = match self {
            Self::Byte => (f32::from(bytes[at] as i8), 127.0),
            Self::UnsignedByte => (f32::from(bytes[at]), 255.0),
            Self::Short => (f32::from(u16_at(bytes, at) as i16), 32767.0),
            Self::UnsignedShort => (f32::from(u16_at(bytes, at)), 65535.0),
            Self::Float => return f32_at(bytes, at),
        };
        if normalized { (value / top).max(-1.0) } else { value }
    }
}

/// An accessor whose numbers are all within its buffer.
pub struct Accessor<'a> {
    pub count: usize,
    bytes: &'a [u8],
    stride: usize,
    component: Component,
    normalized: bool,
}

impl<'a> Accessor<'a> {
    /// Accessor `index`, which `name` calls it, of `width` numbers per row.
    pub fn new(document: &'a Document<'_>, index: usize, name: &str, width: usize) -> Result<Self> {
        let bad = |what: &str| document.bad(format!("has an attribute '{name}' {what}"));
        let accessor = document.item("accessors", index)?;
        if accessor.get("sparse").is_some() {
            return Err(bad(
                "that is sparse, which cannot be read: write it without sparse accessors",
            ));
        }
        let kind = accessor.get("type").and_then(Value::as_str);
        let wanted = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        if kind != Some(wanted) {
            return Err(bad(&format!("that is not {wanted}")));
        }
        let component = accessor
            .get("componentType")
            .and_then(Value::as_u64)
            .and_then(Component::of)
            .ok_or_else(|| bad("of an unsupported component type"))?;
        let count = number(accessor, "count").filter(|&count| count as u64 <= SPLATS_MAX);
        let count = count.ok_or_else(|| bad("without a count below 2^30"))?;
        let view = number(accessor, "bufferView");
        let (view, stride) = document.view(view.ok_or_else(|| {
            bad("without data; compressed splats cannot be read: export them uncompressed")
        })?)?;
        let row = width * component.size();
        let stride = stride.unwrap_or(row);
        let bytes = view.get(number(accessor, "byteOffset").unwrap_or(0)..).unwrap_or(&[]);
        let end = count.checked_sub(1).map(|last| last.checked_mul(stride)?.checked_add(row));
        if stride < row || end.is_some_and(|end| end.is_none_or(|end| end > bytes.len())) {
            return Err(bad("that is longer than its buffer view; it is truncated"));
        }
        let normalized = accessor.get("normalized").and_then(Value::as_bool).unwrap_or(false);
        Ok(Self { count, bytes, stride, component, normalized })
    }

    pub fn row<const N: usize>(&self, i: usize) -> [f32; N] {
        let start = i * self.stride;
        std::array::from_fn(|k| {
            self.component.read(self.bytes, start + k * self.component.size(), self.normalized)
        })
    }
}
