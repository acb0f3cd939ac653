//! The model: parameters of N splats, owned ([`SplatArrays`]) or borrowed ([`SplatParams`]).

use rayon::prelude::*;

use crate::constants::{SH_COEFFS_MAX, SH_DEGREE_MAX};
use crate::error::{Error, Result};
use crate::sh;

/// Color of each splat.
#[derive(Debug, Clone, Copy)]
pub enum Colors<'a, T> {
    /// Spherical harmonics; color = max(0, 0.5 + SH(direction from the camera to the mean)).
    Sh {
        /// Degree to evaluate, 0..=4; may be lower than the stored one.
        degree: u32,
        /// Stored coefficients per splat, at least `(degree + 1)^2`.
        stride: usize,
        /// `[N * stride]` RGB coefficients, splat-major.
        coeffs: &'a [[T; 3]],
    },
    /// `[N]` colors that do not depend on the view, used as they are.
    Direct(&'a [[T; 3]]),
}

/// Parameters of N splats, borrowed.
#[derive(Debug, Clone, Copy)]
pub struct SplatParams<'a, T> {
    /// `[N]` centers in the world frame (less the scene's origin).
    pub means: &'a [[T; 3]],
    /// `[N]` rotations as wxyz quaternions, normalized inside.
    pub quats: &'a [[T; 4]],
    /// `[N]` standard deviations along the splat's axes: logs if `raw`, else themselves.
    pub scales: &'a [[T; 3]],
    /// `[N]` opacities: logits if `raw`, else themselves.
    pub opacities: &'a [T],
    /// Colors.
    pub colors: Colors<'a, T>,
    /// Whether `scales` are logarithms and `opacities` logits (as fitted and stored).
    pub raw: bool,
}

impl<T> SplatParams<'_, T> {
    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Checks that all arrays are of one length and the SH degree is supported.
    pub fn validate(&self) -> Result<()> {
        let n = self.len();
        let lengths = [
            ("quats", self.quats.len()),
            ("scales", self.scales.len()),
            ("opacities", self.opacities.len()),
        ];
        for (name, length) in lengths {
            if length != n {
                return Err(Error::argument(name, format!("has {length} rows, but means has {n}")));
            }
        }
        let rows = match self.colors {
            Colors::Direct(colors) => colors.len(),
            Colors::Sh { degree, stride, coeffs } => {
                let needed = (degree as usize + 1).pow(2);
                if degree > SH_DEGREE_MAX || stride > SH_COEFFS_MAX || stride < needed {
                    return Err(Error::argument(
                        "sh_degree",
                        format!(
                            "degree {degree} needs {needed} coefficients of at most \
                             {SH_COEFFS_MAX}, got {stride}"
                        ),
                    ));
                }
                if coeffs.len() % stride != 0 {
                    return Err(Error::argument("sh", "is not a whole number of splats"));
                }
                coeffs.len() / stride
            }
        };
        if rows != n {
            return Err(Error::argument("colors", format!("has {rows} rows, but means has {n}")));
        }
        Ok(())
    }
}

/// Parameters of N splats as they are fitted and stored. The same layout holds Adam's moments.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatArrays<T = f32> {
    /// `[N]` centers, world frame less the scene's origin.
    pub means: Vec<[T; 3]>,
    /// `[N]` wxyz, not normalized.
    pub quats: Vec<[T; 4]>,
    /// `[N]` logarithms of the standard deviations.
    pub scales: Vec<[T; 3]>,
    /// `[N]` logits.
    pub opacities: Vec<T>,
    /// `[N * (sh_degree + 1)^2]` RGB coefficients, splat-major.
    pub sh: Vec<[T; 3]>,
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

    /// Runs of `size` splats, in order, the last one shorter.
    pub(crate) fn blocks_mut(
        &mut self,
        size: usize,
    ) -> impl IndexedParallelIterator<Item = SplatSlices<'_>> {
        let stride = self.stride();
        let all = SplatSlices {
            means: &mut self.means,
            quats: &mut self.quats,
            scales: &mut self.scales,
            opacities: &mut self.opacities,
            sh: &mut self.sh,
        };
        all.into_blocks(size, stride)
    }
}

/// A run of splats of [`SplatArrays`], or of other arrays in its layout, to be written.
#[derive(Debug)]
pub(crate) struct SplatSlices<'a> {
    pub means: &'a mut [[f32; 3]],
    pub quats: &'a mut [[f32; 4]],
    pub scales: &'a mut [[f32; 3]],
    pub opacities: &'a mut [f32],
    /// Rows of color, equally many per splat.
    pub sh: &'a mut [[f32; 3]],
}

impl<'a> SplatSlices<'a> {
    /// The first `n` splats, of equally many rows of color each.
    pub fn first(self, n: usize) -> SplatSlices<'a> {
        let stride = self.sh.len() / self.means.len().max(1);
        SplatSlices {
            means: &mut self.means[..n],
            quats: &mut self.quats[..n],
            scales: &mut self.scales[..n],
            opacities: &mut self.opacities[..n],
            sh: &mut self.sh[..n * stride],
        }
    }

    /// Borrows raw parameters for the stages: SH of `degree` with `stride` rows per splat.
    pub fn params(&self, degree: u32, stride: usize) -> SplatParams<'_, f32> {
        SplatParams {
            means: self.means,
            quats: self.quats,
            scales: self.scales,
            opacities: self.opacities,
            colors: Colors::Sh { degree, stride, coeffs: self.sh },
            raw: true,
        }
    }

    /// Runs of `size` splats, in order, the last one shorter; each splat has `stride` rows of color.
    pub fn into_blocks(
        self,
        size: usize,
        stride: usize,
    ) -> impl IndexedParallelIterator<Item = Self> {
        (
            self.means.par_chunks_mut(size),
            self.quats.par_chunks_mut(size),
            self.scales.par_chunks_mut(size),
            self.opacities.par_chunks_mut(size),
            self.sh.par_chunks_mut(size * stride),
        )
            .into_par_iter()
            .map(|(means, quats, scales, opacities, sh)| Self {
                means,
                quats,
                scales,
                opacities,
                sh,
            })
    }
}

impl<T> SplatArrays<T> {
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

    /// Borrows the parameters for the stages, with SH up to `degree`, capped at the stored one.
    pub fn params(&self, degree: u32) -> SplatParams<'_, T> {
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
}
