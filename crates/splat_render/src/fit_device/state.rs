//! A fit's state on a device: splats, Adam's moments and density statistics.

use crate::error::{Error, Result};
use crate::splats::SplatArrays;

/// Statistics of each splat since the last density control.
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
    /// Number of splats at the end of the arrays that are drawn and never changed.
    pub frozen: usize,
}

impl FitState {
    /// Fresh optimizer state around `splats`.
    pub fn new(splats: SplatArrays) -> Self {
        let (n, degree) = (splats.len(), splats.sh_degree);
        Self {
            splats,
            first: SplatArrays::zeros(n, degree),
            second: SplatArrays::zeros(n, degree),
            stats: DensityStats::zeros(n),
            frozen: 0,
        }
    }

    /// Number of splats that steps change; they come first.
    pub fn moving(&self) -> usize {
        self.splats.len() - self.frozen
    }

    /// Lets `change` work on the splats that move alone; they may come and go.
    pub fn edit_moving(&mut self, change: impl FnOnce(&mut Self)) {
        if self.frozen == 0 {
            return change(self);
        }
        let moving = self.moving();
        let frozen: Vec<usize> = (moving..self.splats.len()).collect();
        let tail = self.splats.select(&frozen);
        self.select(&(0..moving).collect::<Vec<_>>());
        self.frozen = 0;
        change(self);
        let still = SplatArrays::zeros(frozen.len(), tail.sh_degree);
        self.splats.append(&tail);
        self.first.append(&still);
        self.second.append(&still);
        let n = self.splats.len();
        self.stats.grad_sum.resize(n, 0.0);
        self.stats.seen.resize(n, 0.0);
        self.frozen = frozen.len();
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
        if self.frozen > 0 && self.frozen >= n {
            return Err(Error::argument(
                "frozen_splats",
                format!("must be fewer than the {n} splats, got {}", self.frozen),
            ));
        }
        Ok(())
    }
}
