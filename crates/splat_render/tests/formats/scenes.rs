//! Scenes to write, and how far two of them are apart.

use std::path::{Path, PathBuf};

use splat_render::fit::SplatArrays;
use splat_render::io::{Loaded, SplatFile, read_splats, write_splats};
use splat_render::sh::C0;

/// Endings that can be written.
pub const WRITABLE: [&str; 7] = ["ply", "compressed.ply", "splat", "spz", "sog", "glb", "gltf"];

/// Numbers in [0, 1) that look random: a linear congruence, the high bits.
pub struct Numbers(pub u64);

impl Numbers {
    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 33) as u32
    }

    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 7) as f32 / (1 << 24) as f32
    }

    pub fn within(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    pub fn below(&mut self, count: usize) -> usize {
        self.bits() as usize % count.max(1)
    }
}

/// Typical fitted splats: all values are within every format's range.
pub fn scene(n: usize, degree: u32) -> SplatFile {
    let mut numbers = Numbers(7 + u64::from(degree));
    let mut splats = SplatArrays::zeros(n, degree);
    let stride = splats.stride();
    for i in 0..n {
        splats.means[i] = std::array::from_fn(|_| numbers.within(-3.0, 3.0));
        splats.scales[i] = std::array::from_fn(|_| numbers.within(-6.0, 0.0));
        splats.quats[i] = std::array::from_fn(|_| numbers.within(-1.0, 1.0));
        splats.opacities[i] = numbers.within(-4.0, 4.0);
        splats.sh[i * stride] = std::array::from_fn(|_| numbers.within(-1.7, 1.7));
        for k in 1..stride {
            splats.sh[i * stride + k] = std::array::from_fn(|_| numbers.within(-0.5, 0.5));
        }
    }
    SplatFile { splats, ..SplatFile::default() }
}

/// A new folder for the test `name`.
pub fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("igsr-formats-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

/// Writes and reads `file` with this ending; returns the content and the writer's notes.
pub fn by_way_of(folder: &Path, ending: &str, file: &SplatFile) -> (Loaded, Vec<String>) {
    let path = folder.join(format!("scene.{ending}"));
    let notes = write_splats(&path, file).unwrap();
    (read_splats(&path).unwrap(), notes)
}

/// The bytes of a file of this ending.
pub fn bytes_of(folder: &Path, ending: &str, file: &SplatFile) -> Vec<u8> {
    let path = folder.join(format!("bytes.{ending}"));
    write_splats(&path, file).unwrap();
    std::fs::read(path).unwrap()
}

/// The largest differences between two scenes of the same size, each splat paired with its nearest.
#[derive(Debug, Default)]
pub struct Apart {
    pub mean: f64,
    pub scale: f64,
    pub quat: f64,
    pub opacity: f64,
    pub color: f64,
    pub rest: f64,
    /// Root mean square of the differences whose maximum is `rest`.
    pub rest_rms: f64,
}

impl Apart {
    pub fn of(before: &SplatArrays, after: &SplatArrays) -> Self {
        assert_eq!(before.len(), after.len());
        assert_eq!(before.sh_degree, after.sh_degree);
        let stride = before.stride();
        let mut apart = Self::default();
        let mut used = vec![false; before.len()];
        let (mut squares, mut count) = (0.0, 0);
        let off = |a: f32, b: f32| f64::from((a - b).abs());
        for j in 0..after.len() {
            let far = |i: usize| -> f32 {
                (0..3).map(|k| (before.means[i][k] - after.means[j][k]).powi(2)).sum()
            };
            let i = (0..before.len()).min_by(|&a, &b| far(a).total_cmp(&far(b))).unwrap();
            assert!(!std::mem::replace(&mut used[i], true), "two splats came back as one");
            for k in 0..3 {
                apart.mean = apart.mean.max(off(before.means[i][k], after.means[j][k]));
                apart.scale = apart.scale.max(off(before.scales[i][k], after.scales[j][k]));
                let color = off(before.sh[i * stride][k], after.sh[j * stride][k]);
                apart.color = apart.color.max(color * C0);
            }
            apart.quat = apart.quat.max(quats_apart(before.quats[i], after.quats[j]));
            let opacity = |logit: f32| 1.0 / (1.0 + (-f64::from(logit)).exp());
            let opacities = opacity(before.opacities[i]) - opacity(after.opacities[j]);
            apart.opacity = apart.opacity.max(opacities.abs());
            for k in 1..stride {
                for c in 0..3 {
                    let rest = off(before.sh[i * stride + k][c], after.sh[j * stride + k][c]);
                    apart.rest = apart.rest.max(rest);
                    squares += rest.powi(2);
                    count += 1;
                }
            }
        }
        apart.rest_rms = (squares / f64::from(count.max(1))).sqrt();
        apart
    }

    /// Asserts that no difference is larger than in `most`.
    pub fn assert_within(&self, most: &Self, what: &str) {
        let all = |a: &Self| [a.mean, a.scale, a.quat, a.opacity, a.color, a.rest];
        let within = all(self).iter().zip(all(most)).all(|(off, most)| *off <= most);
        assert!(within, "{what}: {self:?}, allowed {most:?}");
    }
}

pub fn unit(quat: [f32; 4]) -> [f32; 4] {
    let norm = quat.iter().map(|c| c * c).sum::<f32>().sqrt();
    quat.map(|c| c / norm)
}

fn quats_apart(a: [f32; 4], b: [f32; 4]) -> f64 {
    let (a, b) = (unit(a), unit(b));
    let sign = (0..4).map(|k| a[k] * b[k]).sum::<f32>().signum();
    f64::from((0..4).map(|k| (a[k] - sign * b[k]).powi(2)).sum::<f32>().sqrt())
}
