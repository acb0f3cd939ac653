//! Niantic's `.spz`: compressed arrays of attributes.
//!
//! Versions 2 and 3 are one gzip stream of a 16-byte header and six arrays; version 4 is a 32-byte
//! header, extensions, a table of sizes, and a zstd stream for each array. Positions are 24-bit fixed
//! point, rotations three bytes (2) or the smallest three in 32 bits (3, 4). The frame has y up and z
//! back.

use std::io::{Read, Write};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use ruzstd::decoding::StreamingDecoder;

use super::bytes::{Bytes, Named, u32_at, u64_at};
use super::frame::{sh_signs, turn_point, turn_quat};
use super::limits::check_claim;
use super::prepare::{Room, prepare, say_clipped, unfit};
use super::quantize::{SmallestThree, logit_of_byte, opacity_byte, to_f32, to_f64, unit_byte};
use super::{Format, Loaded, SplatFile};
use crate::constants::SH_DEGREE_MAX;
use crate::error::Result;
use crate::sh;
use crate::splats::SplatArrays;

const MAGIC: &[u8; 4] = b"NGSP";
const HEADER: usize = 16;
const HEADER_4: usize = 32;
/// Bytes per array in the table of version 4: compressed size, size.
const TABLE_ROW: usize = 16;
const FLAG_ANTIALIASED: u8 = 1;
const FLAG_EXTENSIONS: u8 = 2;
/// Most bytes of extensions that are looked through: real ones are a few numbers.
const EXTENSIONS_MAX: u64 = 1 << 20;
/// Maximum zstd window besides an array's own size; RFC 8878 asks decoders to support it.
const WINDOW_MAX: u64 = 8 << 20;
/// Most bits after the point: positions have 24 in all.
const FRACTION_BITS_MAX: u8 = 24;
/// A color byte is (0.5 + 0.15 dc) 255.
const COLOR_SCALE: f64 = 0.15;
/// A scale byte is (log-scale + 10) 16.
const SCALE_OFFSET: f64 = 10.0;
const SCALE_STEPS: f64 = 16.0;
/// An SH byte is 128 + 128 coefficient.
const SH_STEPS: f64 = 128.0;
/// A component of a rotation is a sign and 9 bits of its magnitude over sqrt(1/2).
const ROTATION_STEPS: f64 = 511.0;

const ROOM: Room =
    Room { name: ".spz", sh_degree: SH_DEGREE_MAX, origin: false, antialiased: true };

/// The fields of all versions' headers.
struct Header {
    version: u32,
    count: usize,
    degree: u32,
    fraction_bits: u8,
    flags: u8,
}

impl Header {
    fn read(header: &[u8], size: usize, named: &Named<'_>) -> Result<Self> {
        if !header.starts_with(MAGIC) {
            return Err(named.bad("is compressed but not a .spz; give a file of splats"));
        }
        let (version, degree, fraction_bits) = (u32_at(header, 4), header[12], header[13]);
        if !(2..=4).contains(&version) {
            return Err(named.bad(format!(
                "is a .spz of version {version}; 2, 3 and 4 can be read: export it again"
            )));
        }
        if u32::from(degree) > SH_DEGREE_MAX {
            return Err(named.bad(format!("has SH degree {degree}, but only 0 to 4 are known")));
        }
        if fraction_bits > FRACTION_BITS_MAX {
            return Err(named.bad(format!(
                "has positions of {fraction_bits} fractional bits, but only 24 bits; it is \
                 damaged"
            )));
        }
        let degree = u32::from(degree);
        let count = check_claim(named, u64::from(u32_at(header, 8)), degree, size)?;
        Ok(Self { version, count, degree, fraction_bits, flags: header[14] })
    }

    /// Bytes of each array: positions, opacities, colors, scales, rotations, SH.
    fn sizes(&self) -> [usize; 6] {
        let rotation = if self.version == 2 { 3 } else { 4 };
        [9, 1, 3, 3, rotation, 3 * (sh::coeffs(self.degree) - 1)].map(|each| each * self.count)
    }
}

pub fn parse(bytes: &[u8], named: &Named<'_>) -> Result<Loaded> {
    let (header, data) =
        if bytes.starts_with(MAGIC) { open_4(bytes, named)? } else { open_gzip(bytes, named)? };
    let mut data = Bytes::new(&data, named);
    let mut arrays = [&[] as &[u8]; 6];
    for (array, size) in arrays.iter_mut().zip(header.sizes()) {
        *array = data.take(size, "splats")?;
    }
    let mut notes = Vec::new();
    if header.flags & FLAG_EXTENSIONS != 0 {
        notes.push("Extensions of the .spz are ignored.".to_owned());
    }
    let splats = unpack(&header, arrays);
    let antialiased = header.flags & FLAG_ANTIALIASED != 0;
    let file = SplatFile { splats, antialiased, ..SplatFile::default() };
    Ok(Loaded { file, format: Format::Spz, notes })
}

/// Versions 2 and 3: the header, and the arrays.
fn open_gzip(bytes: &[u8], named: &Named<'_>) -> Result<(Header, Vec<u8>)> {
    let damaged = |e| named.bad(format!("cannot be decompressed ({e}); copy or export it again"));
    let mut gzip = GzDecoder::new(bytes);
    let mut header = [0; HEADER];
    gzip.read_exact(&mut header).map_err(damaged)?;
    let header = Header::read(&header, bytes.len(), named)?;
    if header.version == 4 {
        return Err(named.bad("is of version 4 but compressed as version 3; it is damaged"));
    }
    let wanted = header.sizes().iter().sum::<usize>();
    let mut data = Vec::new();
    gzip.take(wanted as u64 + EXTENSIONS_MAX).read_to_end(&mut data).map_err(damaged)?;
    if header.flags & FLAG_EXTENSIONS != 0 && data.len() > wanted {
        // Writers put extensions before the arrays or behind them; before, they fill their place.
        let extra = data.len() - wanted;
        if records_fill(&data[..extra]) {
            data.drain(..extra);
        }
    }
    Ok((header, data))
}

/// Whether `bytes` are records of a type, a length and that number of bytes, up to the last byte.
fn records_fill(mut bytes: &[u8]) -> bool {
    while bytes.len() >= 8 {
        let length = u32_at(bytes, 4) as usize;
        match bytes[8..].split_at_checked(length) {
            Some((_, rest)) => bytes = rest,
            None => return false,
        }
    }
    bytes.is_empty()
}

/// Version 4: the header, and the arrays.
fn open_4(bytes: &[u8], named: &Named<'_>) -> Result<(Header, Vec<u8>)> {
    let head = Bytes::new(bytes, named).take(HEADER_4, "header")?;
    let header = Header::read(head, bytes.len(), named)?;
    if header.version != 4 {
        return Err(named.bad(format!(
            "is of version {} but not compressed as a whole; it is damaged",
            header.version
        )));
    }
    // Empty arrays have no stream.
    let sizes: Vec<usize> = header.sizes().into_iter().filter(|&size| size > 0).collect();
    if usize::from(head[15]) != sizes.len() {
        return Err(named.bad(format!(
            "has {} streams, but {} splats of SH degree {} take {}; it is damaged",
            head[15],
            header.count,
            header.degree,
            sizes.len()
        )));
    }
    let mut rest = Bytes::new(bytes, named);
    rest.take((u32_at(head, 16) as usize).max(HEADER_4), "extensions")?;
    let table = rest.take_rows(sizes.len(), TABLE_ROW, "table of streams")?;
    let mut data = Vec::new();
    for (row, size) in table.chunks_exact(TABLE_ROW).zip(sizes) {
        let (compressed, unpacked) = (u64_at(row, 0), u64_at(row, 8));
        if unpacked != size as u64 {
            return Err(named.bad(format!(
                "has a stream of {unpacked} bytes instead of {size}; it is damaged"
            )));
        }
        let compressed = usize::try_from(compressed).unwrap_or(usize::MAX);
        let stream = rest.take(compressed, "streams")?;
        let start = data.len();
        let window = WINDOW_MAX.max(unpacked);
        StreamingDecoder::new_with_max_window_size(stream, window)
            .map_err(|e| e.to_string())
            .and_then(|zstd| zstd.take(unpacked).read_to_end(&mut data).map_err(|e| e.to_string()))
            .map_err(|e| named.bad(format!("cannot be decompressed ({e}); export it again")))?;
        if data.len() - start != size {
            return Err(named.ends_within("streams"));
        }
    }
    Ok((header, data))
}

fn unpack(header: &Header, arrays: [&[u8]; 6]) -> SplatArrays {
    let [positions, opacities, colors, scales, rotations, rest] = arrays;
    let mut splats = SplatArrays::zeros(header.count, header.degree);
    let stride = splats.stride();
    let signs = sh_signs();
    let unit = (-f64::from(header.fraction_bits)).exp2();
    for i in 0..header.count {
        splats.means[i] = turn_point(std::array::from_fn(|k| {
            let bytes = &positions[9 * i + 3 * k..][..3];
            // The 24 bits on top, so that the shift down carries the sign.
            let fixed = i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8;
            (f64::from(fixed) * unit) as f32
        }));
        splats.opacities[i] = logit_of_byte(opacities[i]);
        splats.scales[i] = std::array::from_fn(|k| {
            (f64::from(scales[3 * i + k]) / SCALE_STEPS - SCALE_OFFSET) as f32
        });
        let xyzw = if header.version == 2 {
            first_three(&rotations[3 * i..][..3])
        } else {
            smallest_three(u32_at(rotations, 4 * i))
        };
        let [x, y, z, w] = to_f32(xyzw);
        splats.quats[i] = turn_quat([w, x, y, z]);
        splats.sh[i * stride] = std::array::from_fn(|c| {
            ((f64::from(colors[3 * i + c]) / 255.0 - 0.5) / COLOR_SCALE) as f32
        });
        for k in 1..stride {
            let bytes = &rest[3 * (i * (stride - 1) + k - 1)..][..3];
            splats.sh[i * stride + k] = std::array::from_fn(|c| {
                ((f64::from(bytes[c]) - SH_STEPS) / SH_STEPS) as f32 * signs[k]
            });
        }
    }
    splats
}

/// xyzw of version 2: x, y and z of the rotation with w not negative.
fn first_three(bytes: &[u8]) -> [f64; 4] {
    let [x, y, z] = std::array::from_fn(|k| f64::from(bytes[k]) / 127.5 - 1.0);
    [x, y, z, (1.0 - x * x - y * y - z * z).max(0.0).sqrt()]
}

/// xyzw of versions 3 and 4.
fn smallest_three(packed: u32) -> [f64; 4] {
    let others = [packed >> 20, packed >> 10, packed].map(|bits| {
        let magnitude = f64::from(bits & 511) / ROTATION_STEPS * std::f64::consts::FRAC_1_SQRT_2;
        if bits & 512 == 0 { magnitude } else { -magnitude }
    });
    SmallestThree { largest: (packed >> 30) as usize, others }.quat()
}

fn pack_rotation(wxyz: [f32; 4]) -> u32 {
    let [w, x, y, z] = to_f64(wxyz);
    let three = SmallestThree::of([x, y, z, w]);
    three.others.iter().fold(three.largest as u32, |packed, c| {
        let magnitude = (c.abs() / std::f64::consts::FRAC_1_SQRT_2 * ROTATION_STEPS).round();
        packed << 10 | u32::from(*c < 0.0) << 9 | (magnitude as u32).min(511)
    })
}

/// Bits after the point that leave room for the largest coordinate, as units are arbitrary.
fn fraction_bits(splats: &SplatArrays) -> Result<u8> {
    let largest = splats.means.as_flattened().iter().fold(0.0f32, |far, c| far.max(c.abs()));
    let limit = f64::from((1u32 << 23) - 1);
    (0..=FRACTION_BITS_MAX)
        .rev()
        .find(|&bits| (f64::from(largest) * f64::from(bits).exp2()).round() <= limit)
        .ok_or_else(|| {
            unfit(&format!("a .spz holds positions up to {limit}, and one is at {largest}"))
        })
}

/// The whole file, of version 3: all readers of today know it.
pub fn encode(file: &SplatFile, notes: &mut Vec<String>) -> Result<Vec<u8>> {
    let splats = prepare(file, &ROOM, notes);
    let (n, stride) = (splats.len(), splats.stride());
    let count = u32::try_from(n).map_err(|_| unfit("a .spz holds at most 2^32 splats"))?;
    let bits = fraction_bits(&splats)?;
    if splats.sh_degree == SH_DEGREE_MAX {
        notes.push("Readers of .spz before 2026 know no SH of degree 4.".to_owned());
    }
    let mut data = Vec::with_capacity(HEADER + n * (20 + 3 * (stride - 1)));
    data.extend(MAGIC);
    data.extend(3u32.to_le_bytes());
    data.extend(count.to_le_bytes());
    let flags = if file.antialiased { FLAG_ANTIALIASED } else { 0 };
    data.extend([splats.sh_degree as u8, bits, flags, 0]);
    for mean in &splats.means {
        for c in turn_point(*mean) {
            let fixed = (f64::from(c) * f64::from(bits).exp2()).round() as i32;
            data.extend(&fixed.to_le_bytes()[..3]);
        }
    }
    data.extend(splats.opacities.iter().map(|&logit| opacity_byte(logit)));
    let mut clipped = 0;
    for dc in splats.sh.iter().step_by(stride).flatten() {
        let value = 0.5 + COLOR_SCALE * f64::from(*dc);
        clipped += usize::from(!(0.0..=1.0).contains(&value));
        data.push(unit_byte(value));
    }
    say_clipped(notes, clipped, "color coefficient", "-3.3 to 3.3");
    clipped = 0;
    for scale in splats.scales.as_flattened() {
        let value = ((f64::from(*scale) + SCALE_OFFSET) * SCALE_STEPS).round();
        clipped += usize::from(!(0.0..=255.0).contains(&value));
        data.push(value as u8);
    }
    say_clipped(notes, clipped, "log-scale", "-10 to 5.9");
    for quat in &splats.quats {
        data.extend(pack_rotation(turn_quat(*quat)).to_le_bytes());
    }
    let signs = sh_signs();
    clipped = 0;
    for row in splats.sh.chunks_exact(stride) {
        for (rgb, sign) in row.iter().zip(signs).skip(1) {
            for c in rgb {
                let value = (f64::from(c * sign) * SH_STEPS + SH_STEPS).round();
                clipped += usize::from(!(0.0..=255.0).contains(&value));
                data.push(value as u8);
            }
        }
    }
    say_clipped(notes, clipped, "SH coefficient", "-1 to 1");
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    let packed = gzip.write_all(&data).and_then(|()| gzip.finish());
    // Writing to memory does not fail.
    packed.map_err(|e| unfit(&format!("cannot be compressed ({e})")))
}
