//! Work that is planned and not done: commands are made as ever, on buffers that have a size and no memory.

use std::collections::HashMap;
use std::sync::Mutex;

/// Sizes of the buffers that work is planned with.
#[derive(Debug, Default)]
pub(super) struct Planned {
    sizes: Mutex<HashMap<wgpu::Buffer, u64>>,
}

impl Planned {
    /// A buffer that stands for one of `size` bytes.
    pub fn buffer(&self, device: &wgpu::Device, size: u64) -> wgpu::Buffer {
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("planned"),
            size: 4,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        if let Ok(mut sizes) = self.sizes.lock() {
            sizes.insert(buffer.clone(), size);
        }
        buffer
    }

    /// What a buffer stands for.
    pub fn size(&self, buffer: &wgpu::Buffer) -> Option<u64> {
        self.sizes.lock().ok().and_then(|sizes| sizes.get(buffer).copied())
    }
}
