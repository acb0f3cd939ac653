//! Splats under optimisation: parameters, Adam's moments and what density control watches.

use crate::error::{Error, Result};
use crate::sh;
use crate::stages::{Colors, SplatParams};

/// Parameters of N splats as they are fitted and stored. The same layout holds Adam's moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatArrays {
    /// `[N]` centres, world frame less the scene's origin.
    pub means: Vec<[f32; 3]>,
    /// `[N]` wxyz, not normalised.
    pub quats: Vec<[f32; 4]>,
    /// `[N]` logarithms of the standard deviations.
    pub scales: Vec<[f32; 3]>,
    /// `[N]` logits.
    pub opacities: Vec<f32>,
    /// `[N * (sh_degree + 1)^2]` RGB coefficients, splat-major.
    pub sh: Vec<[f32; 3]>,
    /// Degree that is stored.
    pub sh_degree: u32,
}

impl SplatArrays {
    /// N splats with all values zero.
    pub fn zeros(n: usize, sh_degree: u32) -> Self {
        Self {
            means: vec![[0.0; 3]; n],
            quats: vec![[0.0; 4]; n],
            scales: vec![[0.0; 3]; n],
            opacities: vec![0.0; n],
            sh: vec![[0.0; 3]; n * sh::coeffs(sh_degree)],
            sh_degree,
        }
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Coefficients per splat and channel.
    pub fn stride(&self) -> usize {
        sh::coeffs(self.sh_degree)
    }

    /// Borrowed as the stages take them, evaluating SH up to `degree` (at most what is stored).
    pub fn params(&self, degree: u32) -> SplatParams<'_, f32> {
        SplatParams {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            colors: Colors::Sh {
                degree: degree.min(self.sh_degree),
                stride: self.stride(),
                coeffs: &self.sh,
            },
            raw: true,
        }
    }

    /// Checks that all arrays are of one length.
    pub fn validate(&self) -> Result<()> {
        self.params(self.sh_degree).validate()?;
        if self.sh.len() != self.len() * self.stride() {
            return Err(Error::argument("sh", "does not have (sh_degree + 1)^2 rows per splat"));
        }
        Ok(())
    }

    /// Keeps the splats at `ids`, in that order (an id may repeat).
    pub fn select(&self, ids: &[usize]) -> Self {
        let stride = self.stride();
        Self {
            means: ids.iter().map(|&i| self.means[i]).collect(),
            quats: ids.iter().map(|&i| self.quats[i]).collect(),
            scales: ids.iter().map(|&i| self.scales[i]).collect(),
            opacities: ids.iter().map(|&i| self.opacities[i]).collect(),
            sh: ids
                .iter()
                .flat_map(|&i| self.sh[i * stride..(i + 1) * stride].iter().copied())
                .collect(),
            sh_degree: self.sh_degree,
        }
    }

    /// Appends the splats of `other`, which stores the same degree.
    pub fn append(&mut self, other: &Self) {
        self.means.extend_from_slice(&other.means);
        self.quats.extend_from_slice(&other.quats);
        self.scales.extend_from_slice(&other.scales);
        self.opacities.extend_from_slice(&other.opacities);
        self.sh.extend_from_slice(&other.sh);
    }

    /// Sets every value of splat `i` to zero.
    pub fn clear(&mut self, i: usize) {
        let stride = self.stride();
        self.means[i] = [0.0; 3];
        self.quats[i] = [0.0; 4];
        self.scales[i] = [0.0; 3];
        self.opacities[i] = 0.0;
        self.sh[i * stride..(i + 1) * stride].fill([0.0; 3]);
    }
}

/// What density control needs to know of each splat since it last ran.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DensityStats {
    /// `[N]` sum over steps of the length of v_means2d in units of half the image's sides
    /// (v.x * width / 2, v.y * height / 2).
    pub grad_sum: Vec<f32>,
    /// `[N]` number of steps in which the splat was visible (not culled).
    pub seen: Vec<f32>,
}

impl DensityStats {
    /// All zero, for N splats.
    pub fn zeros(n: usize) -> Self {
        Self { grad_sum: vec![0.0; n], seen: vec![0.0; n] }
    }
}

/// Everything a device holds of the splats: enough to continue bit for bit.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FitState {
    /// Parameters.
    pub splats: SplatArrays,
    /// Adam's first moments.
    pub first: SplatArrays,
    /// Adam's second moments.
    pub second: SplatArrays,
    /// Since density control last ran.
    pub stats: DensityStats,
}

impl FitState {
    /// Fresh optimiser state around `splats`.
    pub fn new(splats: SplatArrays) -> Self {
        let (n, degree) = (splats.len(), splats.sh_degree);
        Self {
            splats,
            first: SplatArrays::zeros(n, degree),
            second: SplatArrays::zeros(n, degree),
            stats: DensityStats::zeros(n),
        }
    }

    /// Keeps the splats at `ids`, in that order.
    pub fn select(&mut self, ids: &[usize]) {
        for arrays in [&mut self.splats, &mut self.first, &mut self.second] {
            *arrays = arrays.select(ids);
        }
        for values in [&mut self.stats.grad_sum, &mut self.stats.seen] {
            *values = ids.iter().map(|&i| values[i]).collect();
        }
    }

    /// Checks that all arrays belong to the same splats.
    pub fn validate(&self) -> Result<()> {
        let n = self.splats.len();
        for (name, arrays) in
            [("splats", &self.splats), ("first", &self.first), ("second", &self.second)]
        {
            arrays.validate()?;
            if arrays.len() != n || arrays.sh_degree != self.splats.sh_degree {
                return Err(Error::argument(name, "does not belong to the same splats"));
            }
        }
        let DensityStats { grad_sum, seen } = &self.stats;
        if [grad_sum.len(), seen.len()] != [n; 2] {
            return Err(Error::argument("stats", "do not belong to the same splats"));
        }
        Ok(())
    }
}
