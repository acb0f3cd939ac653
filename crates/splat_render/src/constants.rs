//! The renderer's thresholds as f32; the f64 reference widens them, so that comparisons agree.

/// Side of a square tile in pixels. 16 keeps a tile's state inside the first-level cache.
pub const TILE: u32 = 16;

/// Largest image side in pixels: keeps every pixel index in 31 bits.
pub const SIDE_MAX: u32 = 16_384;

/// Pairs fainter than this contribute nothing: below it an 8-bit picture cannot change.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;

/// A clearer pixel of a picture has no depth to compare with a photo's.
pub const DEPTH_ALPHA: f32 = 0.5;

/// No splat is fully opaque, so that `1 - alpha` stays invertible and gradients pass through it.
pub const ALPHA_MAX: f32 = 0.99;

/// A pixel stops before its transmittance falls below this; splats farther away are invisible.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;

/// Default variance in px^2 added to both axes of every 2D covariance (EWA low-pass; gsplat's
/// `eps2d`), so that no splat falls between pixel centers.
pub const BLUR: f32 = 0.3;

/// Default near plane in world units, as gsplat's.
pub const NEAR: f32 = 0.01;

/// Default far plane in world units, as gsplat's.
pub const FAR: f32 = 1e10;

/// The Jacobian's x/z and y/z are limited to this part of `tan(fov / 2)` beyond each image edge:
/// the affine approximation has no meaning far outside the picture (EWA splatting, 3DGS).
pub const JACOBIAN_MARGIN: f32 = 0.3;

/// Quaternions with a smaller squared norm name no rotation; their splats are culled.
pub const QUAT_NORM2_MIN: f32 = 1e-12;

/// Largest deviation of `R R^T` from the identity that still counts as a rigid viewmat.
pub const RIGID_TOLERANCE: f64 = 1e-3;

/// Highest degree of spherical harmonics that is stored or evaluated.
pub const SH_DEGREE_MAX: u32 = 4;

/// Coefficients per channel at [`SH_DEGREE_MAX`].
pub const SH_COEFFS_MAX: usize = 25;

/// Adam's decay of the first and second moments and its epsilon, for the splats' parameters (3DGS).
pub const ADAM: (f32, f32, f32) = (0.9, 0.999, 1e-15);

/// Weights of the SSIM window: 11 taps of a Gaussian of sigma 1.5, summing to 1, as in 3DGS.
pub const SSIM_WINDOW: [f32; 11] = [
    0.001_028_380_1,
    0.007_598_758,
    0.036_000_773,
    0.109_360_69,
    0.213_005_53,
    0.266_011_72,
    0.213_005_53,
    0.109_360_69,
    0.036_000_773,
    0.007_598_758,
    0.001_028_380_1,
];

/// SSIM's constants (C1, C2) for pictures in 0..1.
pub const SSIM_C: (f32, f32) = (0.01 * 0.01, 0.03 * 0.03);
