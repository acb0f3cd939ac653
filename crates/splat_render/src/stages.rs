//! What passes between the stages, and the trait that the implementations share.
//!
//! All arrays are on the host; an implementation may keep its own copies where its kernels run.
//! `T` is f64 in the reference and f32 elsewhere.

use crate::camera::{Camera, check_size};
use crate::constants::{BLUR, FAR, NEAR, SH_COEFFS_MAX, SH_DEGREE_MAX};
use crate::error::{Error, Result};

/// Checks that every named length is `expected`; `unit` goes between the two numbers of the error.
fn check_lengths(lengths: &[(&str, usize)], expected: usize, unit: &str) -> Result<()> {
    for &(name, length) in lengths {
        if length != expected {
            return Err(Error::argument(name, format!("has {length} {unit} {expected}")));
        }
    }
    Ok(())
}

/// Colour of each splat.
#[derive(Debug, Clone, Copy)]
pub enum Colors<'a, T> {
    /// Spherical harmonics; colour = max(0, 0.5 + SH(direction from the camera to the mean)).
    Sh {
        /// Degree that is evaluated, 0..=4; may be lower than what is stored.
        degree: u32,
        /// Stored coefficients per splat, at least `(degree + 1)^2`.
        stride: usize,
        /// `[N * stride]` RGB coefficients, splat-major.
        coeffs: &'a [[T; 3]],
    },
    /// `[N]` colours that do not depend on the view, used as they are.
    Direct(&'a [[T; 3]]),
}

/// Parameters of N splats, borrowed.
#[derive(Debug, Clone, Copy)]
pub struct SplatParams<'a, T> {
    /// `[N]` centres in the world frame (less the scene's origin).
    pub means: &'a [[T; 3]],
    /// `[N]` rotations as wxyz quaternions, normalised inside.
    pub quats: &'a [[T; 4]],
    /// `[N]` standard deviations along the splat's axes: logs if `raw`, else themselves.
    pub scales: &'a [[T; 3]],
    /// `[N]` opacities: logits if `raw`, else themselves.
    pub opacities: &'a [T],
    /// Colours.
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
                return Err(Error::argument(
                    name,
                    format!("has {length} rows where means has {n}"),
                ));
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
                            "degree {degree} needs {needed} coefficients of at most {SH_COEFFS_MAX}, got {stride}"
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
            return Err(Error::argument("colors", format!("has {rows} rows where means has {n}")));
        }
        Ok(())
    }
}

/// Settings of the project stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectOptions {
    /// Splats nearer than this are culled, world units.
    pub near: f32,
    /// Splats farther than this are culled, world units.
    pub far: f32,
    /// Variance in px^2 added to both axes of the 2D covariance.
    pub blur: f32,
    /// Whether opacities are lowered by what the blur adds to a splat's area, so that a splat
    /// seen small keeps its weight in the picture: times sqrt(det S / det(S + blur I)), S the 2D
    /// covariance without blur (the 2D filter of Mip-Splatting, Yu et al. 2024, section 4.2).
    pub antialiased: bool,
}

impl Default for ProjectOptions {
    fn default() -> Self {
        Self { near: NEAR, far: FAR, blur: BLUR, antialiased: false }
    }
}

/// N projected splats, splat-major. A culled splat has radii (0, 0) and zeros elsewhere.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Projected<T> {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Centres in pixels.
    pub means2d: Vec<[T; 2]>,
    /// Upper-triangular factor (p, q, r) of the conic: u = p dx + q dy, v = r dy,
    /// sigma = (u^2 + v^2) / 2, with (dx, dy) = pixel centre - mean2d.
    pub factors: Vec<[T; 3]>,
    /// Camera-space z.
    pub depths: Vec<T>,
    /// Colours.
    pub colors: Vec<[T; 3]>,
    /// Opacities in 0..1, lowered where the project stage was told to (antialiased).
    pub opacities: Vec<T>,
    /// Half-sides in px of the box outside which alpha < `ALPHA_MIN`.
    pub radii: Vec<[T; 2]>,
}

impl<T: Copy + Default> Projected<T> {
    /// N culled splats.
    pub fn culled(n: usize, width: u32, height: u32) -> Self {
        let z = T::default();
        Self {
            width,
            height,
            means2d: vec![[z; 2]; n],
            factors: vec![[z; 3]; n],
            depths: vec![z; n],
            colors: vec![[z; 3]; n],
            opacities: vec![z; n],
            radii: vec![[z; 2]; n],
        }
    }

    /// Checks what a caller may have put together by hand: the size, and that all arrays are of
    /// one length.
    pub fn validate(&self) -> Result<()> {
        check_size(self.width, self.height)?;
        let lengths = [
            ("factors", self.factors.len()),
            ("depths", self.depths.len()),
            ("colors", self.colors.len()),
            ("opacities", self.opacities.len()),
            ("radii", self.radii.len()),
        ];
        check_lengths(&lengths, self.len(), "rows where means2d has")
    }

    /// Number of splats, culled ones included.
    pub fn len(&self) -> usize {
        self.means2d.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means2d.is_empty()
    }
}

/// A rendered picture, row-major, H x W.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image<T> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// RGB over the background.
    pub color: Vec<[T; 3]>,
    /// 1 - final transmittance.
    pub alpha: Vec<T>,
    /// Accumulated depth: sum of weight times camera-space z.
    pub depth: Vec<T>,
    /// Final transmittance.
    pub transmittance: Vec<T>,
}

/// Gradients of a scalar loss with respect to an [`Image`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageGradients<T> {
    /// `[H * W]`
    pub v_color: Vec<[T; 3]>,
    /// `[H * W]`
    pub v_alpha: Vec<T>,
    /// `[H * W]`, of the accumulated depth.
    pub v_depth: Vec<T>,
}

impl<T> ImageGradients<T> {
    /// Checks that these and `image` have as many pixels as the picture of `projected`.
    pub fn validate(&self, projected: &Projected<T>, image: &Image<T>) -> Result<()> {
        let lengths = [
            ("image", image.color.len()),
            ("image", image.depth.len()),
            ("image", image.transmittance.len()),
            ("v_color", self.v_color.len()),
            ("v_alpha", self.v_alpha.len()),
            ("v_depth", self.v_depth.len()),
        ];
        let pixels = projected.width as usize * projected.height as usize;
        check_lengths(&lengths, pixels, "pixels where the picture has")
    }
}

/// Gradients with respect to a [`Projected`] and the background.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ProjectedGradients<T> {
    /// `[N]`
    pub v_means2d: Vec<[T; 2]>,
    /// `[N]`
    pub v_factors: Vec<[T; 3]>,
    /// `[N]`
    pub v_depths: Vec<T>,
    /// `[N]`
    pub v_colors: Vec<[T; 3]>,
    /// `[N]`
    pub v_opacities: Vec<T>,
    /// Gradient of the background colour.
    pub v_background: [T; 3],
    /// `[N]` sums over pixels of the absolute value of each pixel's part of `v_means2d`, where
    /// asked for (AbsGS, Ye et al. 2024; gsplat's `absgrad`); project_backward does not read it.
    pub v_means2d_absolute: Option<Vec<[T; 2]>>,
}

impl<T> ProjectedGradients<T> {
    /// Checks that these and the `projected` splats are as many as the splats.
    pub fn validate(&self, splats: usize, projected: usize) -> Result<()> {
        let lengths = [
            ("projected", projected),
            ("v_means2d", self.v_means2d.len()),
            ("v_factors", self.v_factors.len()),
            ("v_depths", self.v_depths.len()),
            ("v_colors", self.v_colors.len()),
            ("v_opacities", self.v_opacities.len()),
        ];
        check_lengths(&lengths, splats, "rows where means has")
    }
}

impl<T: Copy + Default> ProjectedGradients<T> {
    /// All zero, for N splats.
    pub fn zeros(n: usize) -> Self {
        let z = T::default();
        Self {
            v_means2d: vec![[z; 2]; n],
            v_factors: vec![[z; 3]; n],
            v_depths: vec![z; n],
            v_colors: vec![[z; 3]; n],
            v_opacities: vec![z; n],
            v_background: [z; 3],
            v_means2d_absolute: None,
        }
    }
}

/// Gradients with respect to [`SplatParams`] and the camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatGradients<T> {
    /// `[N]`
    pub v_means: Vec<[T; 3]>,
    /// `[N]` of the quaternions as given (before normalisation).
    pub v_quats: Vec<[T; 4]>,
    /// `[N]` of the scales as given (logs if raw).
    pub v_scales: Vec<[T; 3]>,
    /// `[N]` of the opacities as given (logits if raw).
    pub v_opacities: Vec<T>,
    /// Laid out as the colours were given: `[N * stride]` or `[N]`.
    pub v_colors: Vec<[T; 3]>,
    /// Rows of the gradient of the viewmat's upper 3x4 block.
    pub v_viewmat: [[f64; 4]; 3],
    /// Gradient of (fx, fy, cx, cy).
    pub v_intrinsics: [f64; 4],
}

/// The stages, as every implementation offers them. `bin` runs inside the two rasterize stages.
pub trait Stages<T> {
    /// Splats and camera to 2D splats.
    fn project(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
    ) -> Result<Projected<T>>;

    /// 2D splats to a picture over `background`.
    fn rasterize(&self, projected: &Projected<T>, background: [T; 3]) -> Result<Image<T>>;

    /// Gradients of the picture to gradients of the 2D splats. `image` is what
    /// [`Stages::rasterize`] returned for the same arguments. `absolute` asks for
    /// [`ProjectedGradients::v_means2d_absolute`].
    fn rasterize_backward(
        &self,
        projected: &Projected<T>,
        background: [T; 3],
        image: &Image<T>,
        v_image: &ImageGradients<T>,
        absolute: bool,
    ) -> Result<ProjectedGradients<T>>;

    /// Gradients of the 2D splats to gradients of the splats and the camera.
    fn project_backward(
        &self,
        splats: &SplatParams<'_, T>,
        camera: &Camera,
        options: &ProjectOptions,
        projected: &Projected<T>,
        v_projected: &ProjectedGradients<T>,
    ) -> Result<SplatGradients<T>>;
}
