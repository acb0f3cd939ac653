//! Disables a Vulkan layer that prints an error on machines without a desktop.
//!
//! Mesa's layer `VK_LAYER_MESA_device_select` asks the Wayland compositor which GPU it uses; without one,
//! libwayland prints an error for each adapter query. The layer's manifest names the environment variable
//! `NODEVICE_SELECT` to disable it.

use std::env;
use std::path::Path;
use std::sync::Once;

/// Disables Mesa's layer if Wayland cannot be reached, unless the user has set one of the variables that
/// control it. Call this before Vulkan is loaded.
pub fn silence_device_select() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let is_set = |name: &str| env::var_os(name).is_some();
        let is_absolute =
            |name: &str| env::var_os(name).is_some_and(|path| Path::new(&path).is_absolute());
        // The rule of libwayland's wl_display_connect.
        let has_wayland = is_absolute("XDG_RUNTIME_DIR") || is_absolute("WAYLAND_DISPLAY");
        let is_users = is_set("NODEVICE_SELECT") || is_set("MESA_VK_DEVICE_SELECT");
        if cfg!(target_os = "linux") && !has_wayland && !is_users {
            // SAFETY: setting a variable races with reads of the environment in other threads that go
            // past Rust's lock, as C code may. It happens once in a process, before the Vulkan loader,
            // the only reader of this variable, runs.
            unsafe { env::set_var("NODEVICE_SELECT", "1") };
        }
    });
}
