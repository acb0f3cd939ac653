//! glTF 2.0 with `KHR_gaussian_splatting`, as `.glb` or `.gltf`.
//!
//! Splats are point primitives: positions, rotations xyzw, standard deviations, opacities and SH
//! as accessors. The frame has y up. The gltf crate refuses attributes with a colon in their name,
//! which these have, so that the JSON is read here.

mod accessor;
mod document;
mod read;
mod scene;
mod write;

pub use read::parse;
pub use write::encode;

const EXTENSION: &str = "KHR_gaussian_splatting";
const ROTATION: &str = "KHR_gaussian_splatting:ROTATION";
const SCALE: &str = "KHR_gaussian_splatting:SCALE";
const OPACITY: &str = "KHR_gaussian_splatting:OPACITY";
const SH_DEGREE: u32 = 3;
/// The only kernel that splats here have.
const KERNEL: &str = "ellipse";
const COLOR_SPACE: &str = "srgb_rec709_display";
/// Name of igsr's antialiased flag, which the extension does not define.
const ANTIALIASED: &str = "antialiased";

/// `component type` of 32-bit floats.
const FLOAT: u64 = 5126;

/// First bytes of a `.glb`, and its chunks' kinds.
const MAGIC: &[u8; 4] = b"glTF";
const CHUNK_JSON: &[u8; 4] = b"JSON";
const CHUNK_BINARY: &[u8; 4] = b"BIN\0";
/// Longest `.gltf`, which is in memory as text, as JSON and as bytes at once.
const TEXT_MAX: usize = 512 << 20;

/// The name of SH coefficient `k` of `degree`.
fn sh_name(degree: u32, k: usize) -> String {
    format!("KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{k}")
}
