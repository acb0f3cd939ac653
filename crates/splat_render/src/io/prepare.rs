//! The part of a scene that a format can hold, and notes about the rest.

use std::borrow::Cow;

use super::SplatFile;
use crate::constants::QUAT_NORM2_MIN;
use crate::error::Error;
use crate::sh;
use crate::splats::SplatArrays;

/// Capabilities of a format.
pub struct Room {
    pub name: &'static str,
    pub sh_degree: u32,
    pub origin: bool,
    pub antialiased: bool,
}

/// The splats that a format with this room gets.
pub fn prepare<'a>(
    file: &'a SplatFile,
    room: &Room,
    notes: &mut Vec<String>,
) -> Cow<'a, SplatArrays> {
    let mut splats = Cow::Borrowed(&file.splats);
    let drawn: Vec<usize> = (0..splats.len()).filter(|&i| is_drawn(&splats, i)).collect();
    let left_out = splats.len() - drawn.len();
    if left_out > 0 {
        notes.push(format!(
            "{} that cannot be drawn (not finite, or without a rotation) {} left out.",
            counted(left_out),
            if left_out == 1 { "is" } else { "are" }
        ));
        splats = Cow::Owned(splats.select(&drawn));
    }
    if splats.sh_degree > room.sh_degree {
        notes.push(if room.sh_degree == 0 {
            format!(
                "A {} has no view-dependent color: the spherical harmonics of degree 1 to {} \
                 are dropped.",
                room.name, splats.sh_degree
            )
        } else {
            format!(
                "A {} holds spherical harmonics up to degree {}: those of degree {} are dropped.",
                room.name, room.sh_degree, splats.sh_degree
            )
        });
        splats = Cow::Owned(cut_degree(&splats, room.sh_degree));
    }
    if !room.origin && file.origin != [0.0; 3] {
        let farthest = file.origin.iter().fold(0.0, |far: f64, c| far.max(c.abs())) as f32;
        notes.push(format!(
            "A {} holds no origin: it is added to the positions, which rounds them to about {:.1e} \
             units.",
            room.name,
            farthest * f32::EPSILON
        ));
        let splats = splats.to_mut();
        for mean in &mut splats.means {
            *mean = std::array::from_fn(|k| (f64::from(mean[k]) + file.origin[k]) as f32);
        }
    }
    if !room.antialiased && file.antialiased {
        notes.push(format!(
            "A {} cannot store that the splats are antialiased: choose this in the viewer.",
            room.name
        ));
    }
    splats
}

/// "1 splat" or "12 splats".
pub fn counted(count: usize) -> String {
    format!("{count} splat{}", if count == 1 { "" } else { "s" })
}

/// Notes that `count` values were beyond the range of a format, if there were any.
pub fn say_clipped(notes: &mut Vec<String>, count: usize, what: &str, range: &str) {
    match count {
        0 => {}
        1 => notes.push(format!("1 {what} beyond {range} is clipped.")),
        _ => notes.push(format!("{count} {what}s beyond {range} are clipped.")),
    }
}

/// Whether a renderer draws splat `i`: its numbers are finite, and it has a rotation.
pub fn is_drawn(splats: &SplatArrays, i: usize) -> bool {
    let stride = splats.stride();
    let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
    finite(&splats.means[i])
        && finite(&splats.scales[i])
        && splats.opacities[i].is_finite()
        && splats.sh[i * stride..(i + 1) * stride].iter().all(|rgb| finite(rgb))
        && finite(&splats.quats[i])
        && splats.quats[i].iter().map(|c| c * c).sum::<f32>() >= QUAT_NORM2_MIN
}

/// The splats with SH up to a degree that is lower than theirs.
pub fn cut_degree(splats: &SplatArrays, degree: u32) -> SplatArrays {
    let (stride, kept) = (splats.stride(), sh::coeffs(degree));
    SplatArrays {
        sh: splats.sh.chunks_exact(stride).flat_map(|row| &row[..kept]).copied().collect(),
        sh_degree: degree,
        ..splats.clone()
    }
}

/// The error of splats that a format has no way to hold.
pub fn unfit(what: &str) -> Error {
    Error::argument("splats", format!("{what}; write a .ply, which has no limit"))
}
