//! Buffers: made, filled, and read back.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::commands::Op;
use super::{Gpu, note};
use crate::error::Result;

/// Contents of new buffers in builds with debug assertions: 1.5e9 as a float, out of range as an index. A
/// NaN would not show in gradients, which are set to zero if not finite.
#[cfg(debug_assertions)]
const POISON: u32 = 0x4ead_beef;

/// Smallest buffer: large enough for one element of any binding.
const BUFFER_MIN: u64 = 256;

impl Gpu {
    /// A buffer of at least `bytes`, with nothing of use in it.
    pub(in crate::gpu) fn buffer(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer> {
        let size = bytes.max(BUFFER_MIN).next_multiple_of(4);
        if !self.plans_only && size > self.device.limits().max_buffer_size {
            return Err(
                self.error(&format!("has no room for a buffer of {size} bytes for {label}"))
            );
        }
        if self.injected.buffer_bytes.is_some_and(|most| size > most) {
            return Err(self.error("is out of memory"));
        }
        let size = if self.plans_only { BUFFER_MIN } else { size };
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::INDIRECT
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: cfg!(debug_assertions),
        });
        self.count(size);
        // wgpu clears buffers, which would hide reads of memory that no kernel has written.
        #[cfg(debug_assertions)]
        {
            if let Ok(mut view) = buffer.get_mapped_range_mut(..) {
                let words = vec![POISON; size as usize / 4];
                view.copy_from_slice(bytemuck::cast_slice(&words));
            }
            buffer.unmap();
        }
        self.check()?;
        Ok(buffer)
    }

    /// A buffer of zeros.
    pub(in crate::gpu) fn zeroed(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer> {
        let buffer = self.buffer(label, bytes)?;
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&buffer, 0, None);
        self.queue.submit([encoder.finish()]);
        self.check()?;
        Ok(buffer)
    }

    pub(in crate::gpu) fn bindable_bytes(&self, label: &str, bytes: u64) -> Result<()> {
        if bytes > self.binding_limit {
            return Err(self.error(&format!(
                "binds at most {} bytes at once, but {label} needs {bytes}",
                self.binding_limit
            )));
        }
        Ok(())
    }

    pub(in crate::gpu) fn bindable(&self, label: &str, bytes: u64) -> Result<wgpu::Buffer> {
        self.bindable_bytes(label, bytes)?;
        self.buffer(label, bytes)
    }

    /// Per-pixel state between dispatches that each walk a part of a tile's list; empty if one walks all.
    pub(in crate::gpu) fn transmittances(&self, pixels: u64) -> Result<wgpu::Buffer> {
        let floats = if self.list_limit == u32::MAX { 0 } else { pixels };
        self.bindable("transmittances", 4 * floats)
    }

    pub(in crate::gpu) fn upload<T: bytemuck::NoUninit>(
        &self,
        label: &str,
        contents: &[T],
    ) -> Result<wgpu::Buffer> {
        let bytes: &[u8] = bytemuck::cast_slice(contents);
        let buffer = self.buffer(label, bytes.len() as u64)?;
        if !bytes.is_empty() {
            self.write(&buffer, 0, bytes);
        }
        self.check()?;
        Ok(buffer)
    }

    pub(in crate::gpu) fn write(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        self.count_host(bytes.len() as u64);
        self.host_writes.fetch_add(1, Ordering::Relaxed);
        if !self.plans_only {
            self.queue.write_buffer(buffer, offset, bytes);
        }
    }

    pub(in crate::gpu) fn uniform<T: bytemuck::NoUninit>(&self, contents: &T) -> wgpu::Buffer {
        let size = size_of::<T>().next_multiple_of(16) as u64;
        self.count(size);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("uniform"),
            size,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.count_host(size_of::<T>() as u64);
        self.queue.write_buffer(&buffer, 0, bytemuck::bytes_of(contents));
        buffer
    }

    /// A buffer that the host writes and commands copy from.
    pub(in crate::gpu) fn inputs(&self, bytes: u64) -> wgpu::Buffer {
        self.count(bytes);
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("inputs"),
            size: bytes.next_multiple_of(4),
            usage: wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    /// Runs prepared commands and brings back the first `bytes` of each buffer.
    pub(in crate::gpu) fn download(
        &self,
        ops: &[Op],
        buffers: &[(&wgpu::Buffer, u64)],
    ) -> Result<Vec<Vec<u8>>> {
        let mut encoder = self.device.create_command_encoder(&Default::default());
        Self::record(&mut encoder, ops);
        let total: u64 = buffers.iter().map(|(_, bytes)| bytes).sum();
        if total == 0 {
            self.queue.submit([encoder.finish()]);
            self.check()?;
            return Ok(buffers.iter().map(|_| Vec::new()).collect());
        }
        let mut staging = Vec::new();
        for &(buffer, bytes) in buffers {
            let copy = self.readable(bytes);
            if bytes > 0 {
                encoder.copy_buffer_to_buffer(buffer, 0, &copy, 0, bytes);
            }
            staging.push((copy, bytes));
        }
        self.queue.submit([encoder.finish()]);
        self.check()?;
        let staging: Vec<_> = staging.iter().map(|(copy, bytes)| (copy, *bytes)).collect();
        self.read(&staging)
    }

    /// A buffer that can be copied to and read by the host.
    pub fn readable(&self, bytes: u64) -> wgpu::Buffer {
        let size = bytes.max(4);
        self.count(size);
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("download"),
            size,
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        })
    }

    /// Waits for all work and brings back the first `bytes` of each [`Self::readable`] buffer.
    pub fn read(&self, buffers: &[(&wgpu::Buffer, u64)]) -> Result<Vec<Vec<u8>>> {
        for (buffer, _) in buffers {
            let failure = Arc::clone(&self.failure);
            buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| {
                if let Err(error) = result {
                    note(&failure, format!("returned no results ({error})"));
                }
            });
        }
        self.host_waits.fetch_add(1, Ordering::Relaxed);
        self.wait(wgpu::PollType::wait_indefinitely())
            .inspect_err(|_| buffers.iter().for_each(|(buffer, _)| buffer.unmap()))?;
        buffers.iter().map(|&(buffer, bytes)| self.mapped(buffer, bytes)).collect()
    }

    /// Runs commands and starts to bring back a [`Self::readable`] buffer.
    pub(in crate::gpu) fn submit_read(
        &self,
        ops: &[Op],
        buffer: &wgpu::Buffer,
    ) -> Result<wgpu::SubmissionIndex> {
        let submission = self.submit(&[ops])?;
        // Errors show in finish_read. If the buffer is dropped before, there is none to report.
        buffer.map_async(wgpu::MapMode::Read, .., |_| {});
        Ok(submission)
    }

    /// Waits for no later work than a [`Self::submit_read`], and returns the buffer's first `bytes`.
    pub(in crate::gpu) fn finish_read(
        &self,
        submission: wgpu::SubmissionIndex,
        buffer: &wgpu::Buffer,
        bytes: u64,
    ) -> Result<Vec<u8>> {
        self.wait(wgpu::PollType::Wait { submission_index: Some(submission), timeout: None })
            .inspect_err(|_| buffer.unmap())?;
        self.mapped(buffer, bytes)
    }

    fn wait(&self, until: wgpu::PollType) -> Result<()> {
        let failed = |e| self.error(&format!("did not finish ({e})"));
        self.device.poll(until).map_err(failed)?;
        self.check()
    }

    fn mapped(&self, buffer: &wgpu::Buffer, bytes: u64) -> Result<Vec<u8>> {
        self.count_host(bytes);
        let failed = |e| self.error(&format!("returned no results ({e})"));
        let view = buffer.get_mapped_range(..).map_err(failed)?;
        let data = view[..bytes as usize].to_vec();
        drop(view);
        buffer.unmap();
        Ok(data)
    }
}
