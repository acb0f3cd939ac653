//! Reading glTF.

use glam::{DQuat, DVec3};
use serde_json::Value;

use super::accessor::Accessor;
use super::document::{Document, number};
use super::scene::{Placed, placed_meshes};
use super::{
    ANTIALIASED, COLOR_SPACE, EXTENSION, KERNEL, OPACITY, ROTATION, SCALE, SH_DEGREE, sh_name,
};
use crate::error::Result;
use crate::io::bytes::Named;
use crate::io::frame;
use crate::io::limits::check_claim;
use crate::io::quantize::{logit, to_f32, to_f64};
use crate::io::sh_rotation::ShRotation;
use crate::io::splat::log_scale;
use crate::io::{Format, Loaded, SplatFile};
use crate::sh;
use crate::splats::SplatArrays;

/// Splats of one primitive at one place.
struct Part<'a> {
    at: &'a Placed,
    count: usize,
    degree: u32,
    positions: Accessor<'a>,
    rotations: Accessor<'a>,
    scales: Accessor<'a>,
    opacities: Accessor<'a>,
    sh: Vec<Accessor<'a>>,
}

/// Reads a whole file: all splats of its scene; lower SH degrees are padded with zeros.
pub fn parse(bytes: &[u8], format: Format, named: &Named<'_>) -> Result<Loaded> {
    let document = Document::open(bytes, format, named)?;
    let placed = placed_meshes(&document)?;
    let (mut parts, mut others, mut antialiased) = (Vec::new(), 0, false);
    let mut notes = Vec::new();
    let mut total = 0u64;
    for at in &placed {
        let mesh = document.item("meshes", at.mesh)?;
        let primitives = mesh.get("primitives").and_then(Value::as_array);
        for primitive in primitives.map_or(&[] as &[Value], Vec::as_slice) {
            let Some(extension) = primitive.get("extensions").and_then(|e| e.get(EXTENSION)) else {
                others += 1;
                continue;
            };
            check_extension(&document, extension, &mut notes)?;
            let extras = primitive.get("extras").and_then(|extras| extras.get(ANTIALIASED));
            antialiased |= extras.and_then(Value::as_bool).unwrap_or(false);
            let part = Part::new(&document, primitive, at)?;
            total += part.count as u64;
            // Nodes may instance one mesh many times: check the sum before allocating.
            check_claim(named, total, part.degree, document.size())?;
            parts.push(part);
        }
    }
    let says_splats =
        document.list("extensionsUsed").iter().any(|name| name.as_str() == Some(EXTENSION));
    if parts.is_empty() && (others > 0 || !says_splats) {
        return Err(
            named.bad(format!("shows no splats ({EXTENSION}); give a file of Gaussian splats"))
        );
    }
    // Linear scales are not negative; a few may be damaged.
    let negative = |part: &Part<'_>| {
        (0..part.count).filter(|&i| part.scales.row::<3>(i).iter().any(|&v| v < 0.0)).count() as u64
    };
    let is_log = 2 * parts.iter().map(negative).sum::<u64>() > total;
    if is_log {
        notes
            .push("its scales are logarithms, which glTF does not allow; read as such.".to_owned());
    }
    if others > 0 {
        notes.push(format!("{others} meshes without splats are ignored."));
    }

    let degree = parts.iter().map(|part| part.degree).max().unwrap_or(0);
    check_claim(named, total, degree, document.size())?;
    let mut splats = SplatArrays::zeros(total as usize, degree);
    // The first shift is kept in f64 as the origin.
    let origin = parts.first().map_or(DVec3::ZERO, |part| part.at.translation);
    let mut first = 0;
    for part in &parts {
        part.unpack(&mut splats, first, origin, is_log);
        first += part.count;
    }
    frame::turn(&mut splats);
    // Adding 0 turns -0 into 0, so that origins compare equal.
    let origin = frame::turn_point(origin.to_array()).map(|c| c + 0.0);
    Ok(Loaded { file: SplatFile { splats, origin, antialiased }, format, notes })
}

fn check_extension(
    document: &Document<'_>,
    extension: &Value,
    notes: &mut Vec<String>,
) -> Result<()> {
    let inner = extension.get("extensions").and_then(Value::as_object);
    if let Some(name) = inner.and_then(|names| names.keys().next()) {
        return Err(document.bad(format!(
            "holds splats in the extension {name:?}, which cannot be read: export them without"
        )));
    }
    match extension.get("kernel").and_then(Value::as_str) {
        None | Some(KERNEL) => {}
        Some(kernel) => {
            return Err(
                document.bad(format!("holds splats of the kernel {kernel:?}, not Gaussians"))
            );
        }
    }
    match extension.get("colorSpace").and_then(Value::as_str) {
        None | Some(COLOR_SPACE) => {}
        Some(space) => {
            let note = format!("Colors of the space {space:?} are read as {COLOR_SPACE:?}.");
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    }
    Ok(())
}

impl<'a> Part<'a> {
    fn new(document: &'a Document<'_>, primitive: &Value, at: &'a Placed) -> Result<Self> {
        let attribute = |name: &str, width: usize| -> Result<Option<Accessor<'a>>> {
            match primitive.get("attributes").and_then(|all| number(all, name)) {
                Some(index) => Accessor::new(document, index, name, width).map(Some),
                None => Ok(None),
            }
        };
        let need = |name: &str, width: usize| -> Result<Accessor<'a>> {
            attribute(name, width)?
                .ok_or_else(|| document.bad(format!("has splats without '{name}'")))
        };
        let positions = need("POSITION", 3)?;
        let mut sh = vec![need(&sh_name(0, 0), 3)?];
        let mut degree = 0;
        'degrees: for next in 1..=SH_DEGREE {
            for k in 0..2 * next as usize + 1 {
                match attribute(&sh_name(next, k), 3)? {
                    Some(accessor) => sh.push(accessor),
                    None if k == 0 => break 'degrees,
                    None => {
                        return Err(
                            document.bad(format!("has splats without '{}'", sh_name(next, k)))
                        );
                    }
                }
            }
            degree = next;
        }
        let part = Self {
            at,
            count: positions.count,
            degree,
            positions,
            rotations: need(ROTATION, 4)?,
            scales: need(SCALE, 3)?,
            opacities: need(OPACITY, 1)?,
            sh,
        };
        let all = [&part.rotations, &part.scales, &part.opacities];
        if all.into_iter().chain(&part.sh).any(|accessor| accessor.count != part.count) {
            return Err(document.bad("has attributes of different length; it is damaged"));
        }
        Ok(part)
    }

    /// Writes this part's splats, in glTF's frame, from splat `first` on.
    fn unpack(&self, splats: &mut SplatArrays, first: usize, origin: DVec3, is_log: bool) {
        let stride = splats.stride();
        let shift = self.at.translation - origin;
        let moved = self.at.rotation.is_some() || self.at.scale != 1.0 || shift != DVec3::ZERO;
        let turn = self.at.rotation.unwrap_or(DQuat::IDENTITY);
        let sh_turn = self
            .at
            .rotation
            .map(|turn| ShRotation::new(|d| (turn.inverse() * DVec3::from_array(d)).to_array()));
        for i in 0..self.count {
            let to = first + i;
            splats.means[to] = self.positions.row(i);
            let [x, y, z, w] = self.rotations.row::<4>(i);
            splats.quats[to] = [w, x, y, z];
            splats.scales[to] = self.scales.row::<3>(i);
            if !is_log {
                splats.scales[to] = splats.scales[to].map(log_scale);
            }
            let [opacity] = self.opacities.row::<1>(i);
            splats.opacities[to] = logit(f64::from(opacity));
            let row = &mut splats.sh[to * stride..(to + 1) * stride];
            for (coefficient, accessor) in row.iter_mut().zip(&self.sh) {
                *coefficient = accessor.row(i);
            }
            if !moved {
                continue;
            }
            let mean = DVec3::from_array(to_f64(splats.means[to]));
            splats.means[to] = to_f32((turn * (mean * self.at.scale) + shift).to_array());
            for scale in &mut splats.scales[to] {
                *scale += self.at.scale.ln() as f32;
            }
            if let Some(sh_turn) = &sh_turn {
                let quat = DQuat::from_array(to_f64([x, y, z, w]));
                let [x, y, z, w] = to_f32((turn * quat).to_array());
                splats.quats[to] = [w, x, y, z];
                sh_turn.apply(&mut row[..sh::coeffs(self.degree)]);
            }
        }
    }
}
