//! The text at the head of a `.ply`.

use std::io::{BufRead, Read, Write};

use super::bytes::Named;
use super::limits::SPLATS_MAX;
use super::ply::FILTER;
use super::splat_file::SplatFile;
use crate::error::Result;

/// Longest header that is read: real ones are under 3 kB.
const HEADER_MAX: u64 = 1 << 16;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Float,
    Double,
    Uint,
    Uchar,
    Other,
}

/// Bytes of a scalar type, and which it is; None if unknown.
fn scalar(name: &str) -> Option<(usize, Kind)> {
    Some(match name {
        "uchar" | "uint8" => (1, Kind::Uchar),
        "char" | "int8" => (1, Kind::Other),
        "short" | "ushort" | "int16" | "uint16" => (2, Kind::Other),
        "uint" | "uint32" => (4, Kind::Uint),
        "int" | "int32" => (4, Kind::Other),
        "float" | "float32" => (4, Kind::Float),
        "double" | "float64" => (8, Kind::Double),
        _ => return None,
    })
}

/// A property of an element.
pub struct Property {
    pub name: String,
    pub kind: Kind,
    /// Its first byte within a row.
    pub offset: usize,
}

/// A table of the file.
pub struct Element {
    pub name: String,
    pub count: u64,
    /// Bytes per row.
    pub stride: usize,
    /// Columns, in the file's order.
    pub properties: Vec<Property>,
    /// Whether a column holds lists, so that rows differ in size.
    pub lists: bool,
}

impl Element {
    /// First byte within a row of the column `name` of type `kind`.
    pub fn offset(&self, name: &str, kind: Kind) -> Option<usize> {
        self.properties.iter().find(|p| p.kind == kind && p.name == name).map(|p| p.offset)
    }

    pub fn size(&self) -> u64 {
        self.count.saturating_mul(self.stride as u64)
    }
}

#[derive(Default)]
pub struct Header {
    /// Tables in the order of the file.
    pub elements: Vec<Element>,
    /// `comment origin X Y Z`, else zero.
    pub origin: [f64; 3],
    /// `comment SplatRenderMode: mip`, or splats of Mip-Splatting.
    pub antialiased: bool,
}

impl Header {
    /// Reads up to and with the line `end_header`.
    pub fn read(reader: &mut impl BufRead, named: &Named<'_>) -> Result<Self> {
        let mut limited = reader.take(HEADER_MAX);
        let mut line = || -> Result<String> {
            let mut bytes = Vec::new();
            limited
                .read_until(b'\n', &mut bytes)
                .map_err(|e| named.bad(format!("cannot be read ({e})")))?;
            if bytes.last() != Some(&b'\n') {
                return Err(named.bad("ends within its header; it is not a whole .ply file"));
            }
            Ok(String::from_utf8_lossy(&bytes).trim_end().to_owned())
        };
        if line().ok().as_deref() != Some("ply") {
            return Err(named.bad("does not start with 'ply'; give a .ply file of splats"));
        }
        let (mut header, mut format) = (Self::default(), false);
        loop {
            let line = line()?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words.as_slice() {
                ["end_header"] => break,
                ["format", kind, ..] => {
                    format = true;
                    if *kind != "binary_little_endian" {
                        return Err(named.bad(format!(
                            "is in the format {kind}; only binary_little_endian can be read"
                        )));
                    }
                }
                // Of earlier versions of igsr and of Postshot; of Brush, gsplat and nerfstudio.
                ["comment", "antialiased"]
                | ["comment", "antialiased", "1"]
                | ["comment", "SplatRenderMode:", "mip"] => header.antialiased = true,
                ["comment", "origin", xyz @ ..] => {
                    let values = xyz.iter().map(|v| v.parse().ok().filter(|v: &f64| v.is_finite()));
                    let values = values.collect::<Option<Vec<f64>>>();
                    // Comments of other programs may start with the same word.
                    let origin = values.and_then(|v| <[f64; 3]>::try_from(v).ok());
                    header.origin = origin.unwrap_or(header.origin);
                }
                ["element", name, count] => {
                    let count =
                        count.parse().ok().filter(|&n| n <= SPLATS_MAX).ok_or_else(|| {
                            named.bad(format!("claims {count} splats; at most 2^30 can be"))
                        })?;
                    header.elements.push(Element {
                        name: (*name).to_owned(),
                        count,
                        stride: 0,
                        properties: Vec::new(),
                        lists: false,
                    });
                }
                ["property", "list", ..] => {
                    if let Some(element) = header.elements.last_mut() {
                        element.lists = true;
                    }
                }
                ["property", kind, name] => {
                    let (size, kind) = scalar(kind).ok_or_else(|| {
                        named.bad(format!("has a property of unknown type {kind}"))
                    })?;
                    if let Some(element) = header.elements.last_mut() {
                        header.antialiased |= *name == FILTER;
                        let offset = element.stride;
                        element.properties.push(Property {
                            name: (*name).to_owned(),
                            kind,
                            offset,
                        });
                        element.stride += size;
                    }
                }
                _ => {}
            }
        }
        if !format || header.elements.is_empty() {
            return Err(named.bad("has no format or no vertex element in its header"));
        }
        Ok(header)
    }

    /// Whether a table of that name comes first.
    pub fn starts_with(&self, name: &str) -> bool {
        self.elements.first().is_some_and(|element| element.name == name)
    }
}

/// The header's first lines, with the data that .ply has no property for.
pub fn write_comments(out: &mut impl Write, file: &SplatFile) -> std::io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0")?;
    if file.origin != [0.0; 3] {
        let [x, y, z] = file.origin;
        writeln!(out, "comment origin {x:?} {y:?} {z:?}")?;
    }
    if file.antialiased {
        writeln!(out, "comment SplatRenderMode: mip")?;
    }
    Ok(())
}
