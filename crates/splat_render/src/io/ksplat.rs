//! mkkellogg's `.ksplat`, versions 0.1 and later: a header, headers of sections, sections.
//!
//! Level 0 holds floats; levels 1 and 2 hold positions as u16 about the center of a bucket and the
//! rest as half floats, level 2 its SH as bytes. SH is per degree: all red, all green, all blue.

use half::f16;

use super::bytes::{Bytes, Named, f32_at, u16_at, u32_at};
use super::limits::check_claim;
use super::quantize::{dc_of_color, logit_of_byte};
use super::splat::log_scale;
use super::{Format, Loaded, SplatFile};
use crate::error::Result;
use crate::sh;
use crate::splats::SplatArrays;

const HEADER: usize = 4096;
const SECTION_HEADER: usize = 1024;
const SH_DEGREE: u32 = 2;
/// Half the range of level 2's SH bytes if the header gives none.
const SH_HALF_RANGE: f32 = 1.5;
/// Steps from a bucket's center to its side if the section gives none.
const POSITION_STEPS: u32 = 32767;

/// Layout of a splat at one compression level.
struct Level {
    scale: usize,
    rotation: usize,
    color: usize,
    sh: usize,
    sh_bytes: usize,
}

const LEVELS: [Level; 3] = [
    Level { scale: 12, rotation: 24, color: 40, sh: 44, sh_bytes: 4 },
    Level { scale: 6, rotation: 12, color: 20, sh: 24, sh_bytes: 2 },
    Level { scale: 6, rotation: 12, color: 20, sh: 24, sh_bytes: 1 },
];

struct Section<'a> {
    count: usize,
    degree: u32,
    stride: usize,
    rows: &'a [u8],
    /// Splats per full bucket, and the number of full buckets; the sizes of partial buckets follow.
    bucket_size: usize,
    full_buckets: usize,
    partial_sizes: &'a [u8],
    /// Bytes per bucket; the first 12 are its center.
    bucket_stride: usize,
    buckets: &'a [u8],
    /// World units per step of a position.
    step: f32,
    steps: f32,
}

pub fn parse(bytes: &[u8], named: &Named<'_>) -> Result<Loaded> {
    let mut data = Bytes::new(bytes, named);
    let header = data.take(HEADER, "header")?;
    if header[0] != 0 || header[1] < 1 {
        return Err(named.bad(format!(
            "is a .ksplat of version {}.{}; only 0.1 and later 0.x can be read: export it again",
            header[0], header[1]
        )));
    }
    let level_number = u16_at(header, 20);
    let level = LEVELS.get(usize::from(level_number)).ok_or_else(|| {
        named.bad(format!("has the compression level {level_number}, but only 0 to 2 are known"))
    })?;
    let range = |at: usize, default: f32| match f32_at(header, at) {
        0.0 => default,
        given => given,
    };
    let sh_range = (range(36, -SH_HALF_RANGE), range(40, SH_HALF_RANGE));
    // Writers leave the number of used sections at 0; unused ones hold no splats.
    let reserved = u32_at(header, 4) as usize;
    let headers = data.take_rows(reserved, SECTION_HEADER, "section headers")?;
    let mut sections = Vec::with_capacity(reserved);
    for header in headers.chunks_exact(SECTION_HEADER) {
        sections.push(Section::take(&mut data, header, level, named)?);
    }

    let count: usize = sections.iter().map(|section| section.count).sum();
    let degree = sections.iter().map(|section| section.degree).max().unwrap_or(0);
    let claimed = u32_at(header, 16);
    if claimed as usize != count {
        return Err(named
            .bad(format!("claims {claimed} splats but its sections hold {count}; it is damaged")));
    }
    check_claim(named, count as u64, degree, bytes.len())?;
    let mut splats = SplatArrays::zeros(count, degree);
    let mut first = 0;
    for section in &sections {
        section.unpack(&mut splats, first, level, sh_range);
        first += section.count;
    }
    Ok(Loaded {
        file: SplatFile { splats, ..SplatFile::default() },
        format: Format::Ksplat,
        notes: Vec::new(),
    })
}

impl<'a> Section<'a> {
    fn take(data: &mut Bytes<'a>, header: &[u8], level: &Level, named: &Named<'_>) -> Result<Self> {
        let [count, reserved, bucket_size, bucket_count] =
            [0, 4, 8, 12].map(|at| u32_at(header, at) as usize);
        let (full_buckets, partial) = (u32_at(header, 32) as usize, u32_at(header, 36) as usize);
        let degree = u32::from(u16_at(header, 40));
        if degree > SH_DEGREE {
            return Err(named.bad(format!("has SH degree {degree}, but a .ksplat has 0 to 2")));
        }
        if count > reserved {
            return Err(
                named.bad(format!("has {count} splats, but only {reserved} fit; it is damaged"))
            );
        }
        let bucket_stride = usize::from(u16_at(header, 20));
        let stride = level.sh + level.sh_bytes * 3 * (sh::coeffs(degree) - 1);
        let partial_sizes = data.take_rows(partial, 4, "buckets")?;
        let buckets = data.take_rows(bucket_count, bucket_stride, "buckets")?;
        let rows = data.take_rows(reserved, stride, "splats")?;
        let steps = match u32_at(header, 24) {
            0 => POSITION_STEPS,
            given => given,
        } as f32;
        let section = Self {
            count,
            degree,
            stride,
            rows,
            bucket_size,
            full_buckets,
            partial_sizes,
            bucket_stride,
            buckets,
            step: f32_at(header, 16) / 2.0 / steps,
            steps,
        };
        if level.scale != LEVELS[0].scale && !section.buckets_cover(bucket_count) {
            return Err(named.bad("has splats outside of its buckets; it is damaged"));
        }
        Ok(section)
    }

    fn partial_size(&self, bucket: usize) -> usize {
        u32_at(self.partial_sizes, 4 * bucket) as usize
    }

    /// Whether every splat has a bucket with a center.
    fn buckets_cover(&self, bucket_count: usize) -> bool {
        let partial = self.partial_sizes.len() / 4;
        let full = self.bucket_size.saturating_mul(self.full_buckets);
        let covered = (0..partial).fold(full, |sum, b| sum.saturating_add(self.partial_size(b)));
        self.count == 0
            || self.bucket_stride >= 12
                && covered >= self.count
                && self.full_buckets.saturating_add(partial) <= bucket_count
    }

    fn unpack(&self, splats: &mut SplatArrays, first: usize, level: &Level, sh_range: (f32, f32)) {
        let wide = level.scale == LEVELS[0].scale;
        let number = |row: &[u8], start: usize, k: usize| {
            if wide {
                f32_at(row, start + 4 * k)
            } else {
                f16::from_bits(u16_at(row, start + 2 * k)).to_f32()
            }
        };
        let coefficient = |row: &[u8], k: usize| match level.sh_bytes {
            1 => sh_range.0 + f32::from(row[level.sh + k]) / 255.0 * (sh_range.1 - sh_range.0),
            _ => number(row, level.sh, k),
        };
        let full = self.bucket_size.saturating_mul(self.full_buckets);
        let (mut bucket, mut bucket_end) = (self.full_buckets, full);
        let stride = splats.stride();
        for (i, row) in self.rows.chunks_exact(self.stride).take(self.count).enumerate() {
            let to = first + i;
            splats.means[to] = if wide {
                std::array::from_fn(|k| f32_at(row, 4 * k))
            } else {
                let home = if i < full {
                    i / self.bucket_size
                } else {
                    while i >= bucket_end {
                        bucket_end += self.partial_size(bucket - self.full_buckets);
                        bucket += 1;
                    }
                    bucket - 1
                };
                let center = &self.buckets[home * self.bucket_stride..][..12];
                std::array::from_fn(|k| {
                    (f32::from(u16_at(row, 2 * k)) - self.steps) * self.step + f32_at(center, 4 * k)
                })
            };
            splats.scales[to] = std::array::from_fn(|k| log_scale(number(row, level.scale, k)));
            splats.quats[to] = std::array::from_fn(|k| number(row, level.rotation, k));
            let [r, g, b, opacity] = std::array::from_fn(|c| row[level.color + c]);
            splats.sh[to * stride] = [r, g, b].map(|c| dc_of_color(f64::from(c) / 255.0));
            splats.opacities[to] = logit_of_byte(opacity);
            for degree in 1..=self.degree {
                let (start, each) = (sh::coeffs(degree - 1), 2 * degree as usize + 1);
                for k in 0..each {
                    splats.sh[to * stride + start + k] =
                        std::array::from_fn(|c| coefficient(row, 3 * (start - 1) + c * each + k));
                }
            }
        }
    }
}
