//! The up axis of a scene without cameras, estimated from its splats.
//!
//! Scenes mostly stand on something flat: a floor, a table, a lawn. Its splats are flat and lie in it,
//! so their shortest axes share a direction, and most of the scene is on one side of them. Walls do so,
//! too; the axes that captures usually have (y down, z up) decide between planes that are alike.

use glam::{DMat3, DQuat, DVec3};
use splat_render::io::SplatFile;

/// Default up axis: in COLMAP's scenes, and so in most captures, y points down.
pub const USUAL: DVec3 = DVec3::NEG_Y;
/// Up axes of conventions: COLMAP's, and transforms.json's.
const CONVENTIONS: [DVec3; 2] = [DVec3::NEG_Y, DVec3::Z];
/// Splats of a lower opacity logit do not count.
const FAINT_LOGIT: f32 = 0.0;
const SAMPLES: usize = 20_000;
/// A flat splat's shortest axis is at most so long, of the middle one.
const FLAT: f64 = 0.4;
/// Cosine of the angle, 12 degrees, within which directions are alike.
const PARALLEL: f64 = 0.978;
const DIRECTIONS: usize = 1500;
/// Maximum bonus of a convention's direction.
const BONUS: f64 = 1.0;
/// Minimum weight of a plane relative to the mean over directions.
const MIN_WEIGHT: f64 = 4.0;
/// Minimum number of splats in a plane.
const MIN_SPLATS: usize = 20;

struct Flake {
    at: DVec3,
    /// Its shortest axis, or zero if it is not flat.
    normal: DVec3,
    weight: f64,
}

/// The estimated up axis, a unit vector; [`USUAL`] if the splats have no common plane.
pub fn up_of_splats(file: &SplatFile, center: DVec3, radius: f64) -> DVec3 {
    estimated(&flakes(file, center, radius)).unwrap_or(USUAL)
}

/// Splats near the middle; places are relative to it, in radii.
fn flakes(file: &SplatFile, center: DVec3, radius: f64) -> Vec<Flake> {
    let splats = &file.splats;
    let step = splats.len().div_ceil(SAMPLES).max(1);
    let middle = center - DVec3::from(file.origin);
    let flake = |i: usize| {
        let at = (DVec3::from(splats.means[i].map(f64::from)) - middle) / radius;
        let [w, x, y, z] = splats.quats[i].map(f64::from);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let lengths = splats.scales[i].map(|log| f64::from(log).exp());
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| lengths[a].total_cmp(&lengths[b]));
        let [short, middle, long] = order.map(|axis| lengths[axis]);
        let normal = rotation.col(order[0]);
        // One huge splat does not outweigh a surface of many.
        let area = (middle * long / (radius * radius)).min(1e-3);
        let is_known = at.is_finite() && normal.is_finite() && area.is_finite() && area > 0.0;
        let is_seen = is_known && at.length() < 3.0 && splats.opacities[i] > FAINT_LOGIT;
        let normal = if short < FLAT * middle { normal } else { DVec3::ZERO };
        is_seen.then_some(Flake { at, normal, weight: area })
    };
    (0..splats.len()).step_by(step).filter_map(flake).collect()
}

fn estimated(flakes: &[Flake]) -> Option<DVec3> {
    let flat = flakes.iter().filter(|flake| flake.normal != DVec3::ZERO);
    let total: f64 = flat.map(|flake| flake.weight).sum();
    if total <= 0.0 {
        return None;
    }
    let along = |direction: DVec3| {
        flakes.iter().filter(move |flake| flake.normal.dot(direction).abs() > PARALLEL)
    };
    let score = |direction: DVec3| {
        let usual = CONVENTIONS.iter().map(|up| up.dot(direction).abs()).fold(0.0, f64::max);
        // Only near a convention's axis: cameras are seldom held straight, and seldom upside down.
        let bonus = 1.0 + BONUS * ((usual - 0.9) / 0.1).max(0.0);
        along(direction).map(|flake| flake.weight).sum::<f64>() * bonus
    };
    let best = directions()
        .map(|direction| (score(direction), direction))
        .max_by(|(one, _), (other, _)| one.total_cmp(other))?
        .1;
    // Directions within the angle cover this part of the sphere's halves.
    let by_chance = total * (1.0 - PARALLEL);
    let weight: f64 = along(best).map(|flake| flake.weight).sum();
    if weight < MIN_WEIGHT * by_chance || along(best).count() < MIN_SPLATS {
        return None;
    }
    let mean: DVec3 =
        along(best).map(|f| f.normal * (f.weight * f.normal.dot(best).signum())).sum();
    let up = mean.try_normalize()?;
    // The scene stands on the plane: up is the side with the rest of the splats. Medians, since few
    // photos leave large splats below at arbitrary places.
    let height = |is_ground: bool| {
        let there = |flake: &&Flake| (flake.normal.dot(best).abs() > PARALLEL) == is_ground;
        median(flakes.iter().filter(there).map(|flake| flake.at.dot(up)).collect())
    };
    Some(if height(false) < height(true) { -up } else { up })
}

/// The value that half of the values are below; 0 of none.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Directions over half a sphere, evenly (a Fibonacci lattice).
fn directions() -> impl Iterator<Item = DVec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..DIRECTIONS).map(move |i| {
        let z = (i as f64 + 0.5) / DIRECTIONS as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let radius = (1.0 - z * z).sqrt();
        DVec3::new(radius * cos, radius * sin, z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_render::fit::SplatArrays;

    /// A floor of flat splats with some that stand on it, turned so that `up` is upward.
    fn room(up: DVec3) -> SplatFile {
        let turn = DQuat::from_rotation_arc(DVec3::Z, up);
        let mut splats = SplatArrays::default();
        let mut add = |at: DVec3, normal: DVec3| {
            let at = turn * at;
            let quat = turn * DQuat::from_rotation_arc(DVec3::Z, normal);
            splats.means.push(at.to_array().map(|v| v as f32));
            splats.quats.push([quat.w, quat.x, quat.y, quat.z].map(|v| v as f32));
            splats.scales.push([-2.5, -2.5, -5.0]);
            splats.opacities.push(3.0);
            splats.sh.push([0.0; 3]);
        };
        for x in -10..=10 {
            for y in -10..=10 {
                add(DVec3::new(0.1 * f64::from(x), 0.1 * f64::from(y), 0.0), DVec3::Z);
            }
        }
        for i in 0..150 {
            let (sin, cos) = (f64::from(i) * 0.7).sin_cos();
            let place = DVec3::new(0.3 * cos, 0.3 * sin, 0.004 * f64::from(i));
            add(place, DVec3::new(cos, sin, 0.3).normalize());
        }
        SplatFile { splats, origin: [0.0; 3], antialiased: false }
    }

    #[test]
    fn up_is_the_side_of_the_floor_with_objects() {
        for up in [DVec3::NEG_Y, DVec3::Z, DVec3::X, DVec3::new(0.3, -0.8, -0.5).normalize()] {
            let found = up_of_splats(&room(up), DVec3::ZERO, 1.0);
            assert!(found.dot(up) > 0.999, "{found} for {up}");
        }
    }

    #[test]
    fn without_a_plane_up_is_the_usual_axis() {
        let mut file = room(DVec3::X);
        file.splats.opacities.fill(-4.0);
        assert_eq!(up_of_splats(&file, DVec3::ZERO, 1.0), USUAL);
        file.splats.opacities.fill(f32::NAN);
        assert_eq!(up_of_splats(&file, DVec3::ZERO, 1.0), USUAL);
        let mut file = room(DVec3::X);
        file.splats.quats.fill([0.0; 4]);
        assert_eq!(up_of_splats(&file, DVec3::ZERO, 1.0), USUAL);
        file.splats.scales.fill([-2.0; 3]);
        assert_eq!(up_of_splats(&file, DVec3::ZERO, 1.0), USUAL);
        let none = SplatFile { splats: SplatArrays::default(), ..file };
        assert_eq!(up_of_splats(&none, DVec3::ZERO, 1.0), USUAL);
    }
}
