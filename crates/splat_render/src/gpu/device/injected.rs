//! Faults for tests, since no failing adapter is at hand.

use super::limits::needed_limits;

/// Faults of an adapter. The default has none.
#[derive(Debug, Clone, Default)]
pub struct Injected {
    /// A software adapter passes for a real one.
    pub passes_for_real: bool,
    /// The driver refuses a shader.
    pub bad_shader: bool,
    /// Kernels compute wrong values.
    pub wrong_values: bool,
    /// The kernels for GPUs compute wrong values.
    pub wrong_blocks: bool,
    /// Limits of the adapter, used if lower than its real ones.
    pub limits: Option<wgpu::Limits>,
    /// Larger buffers are more than the memory holds.
    pub buffer_bytes: Option<u64>,
}

impl Injected {
    /// An adapter that binds fewer buffers than the kernels need.
    pub fn with_low_limits(self) -> Self {
        let limits = wgpu::Limits { max_storage_buffers_per_shader_stage: 4, ..needed_limits() };
        Self { limits: Some(limits), ..self }
    }

    /// Whether results are correct.
    pub fn is_sound(&self) -> bool {
        !self.bad_shader && !self.wrong_values && !self.wrong_blocks
    }

    /// The text of a shader as the driver takes it.
    pub(super) fn text(&self, text: String) -> String {
        if self.bad_shader {
            return text + "\nfn no_driver_takes_this(";
        }
        if self.wrong_values {
            // Wrong values: a much lower cap on alpha.
            return text.replace("const ALPHA_MAX = ", "const ALPHA_MAX = 0.5 * ");
        }
        if self.wrong_blocks {
            // Two of eight blocks stay empty.
            return text.replace("block < BLOCKS; block += 2u", "block < 6u; block += 2u");
        }
        text
    }
}
