//! Times of commands on the device, by timestamps.

use super::{Gpu, Op};
use crate::error::Result;
use crate::fit_device::CommandTime;

impl Gpu {
    /// Runs lists of prepared commands, each command in a separate pass, and waits for them.
    ///
    /// A command's time is the difference between the ends of its pass and of the pass before. Timestamps
    /// at the beginning of passes are less exact: llvmpipe writes them after the first dispatch.
    pub(in crate::gpu) fn submit_timed(&self, lists: &[&[Op]]) -> Result<Vec<CommandTime>> {
        if !self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return Err(self.error("has no timestamps to measure kernels with"));
        }
        let ops: Vec<&Op> = lists.iter().copied().flatten().collect();
        let count = ops.len() as u32 + 1;
        if count > wgpu::QUERY_SET_MAX_QUERIES {
            return Err(
                self.error(&format!("measures no step of {count} commands; use a smaller photo"))
            );
        }
        let set = self.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("times"),
            ty: wgpu::QueryType::Timestamp,
            count,
        });
        let bytes = u64::from(count) * u64::from(wgpu::QUERY_SIZE);
        let resolved = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("times"),
            size: bytes,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let end = |query| {
            Some(wgpu::ComputePassTimestampWrites {
                query_set: &set,
                beginning_of_pass_write_index: None,
                end_of_pass_write_index: Some(query),
            })
        };
        let mut encoder = self.device.create_command_encoder(&Default::default());
        Self::record_pass(&mut encoder, &[], end(0));
        for (op, query) in ops.iter().zip(1..) {
            let op = std::slice::from_ref(*op);
            if let [Op::Dispatch { .. }] = op {
                Self::record_pass(&mut encoder, op, end(query));
            } else {
                Self::record(&mut encoder, op);
                Self::record_pass(&mut encoder, &[], end(query));
            }
        }
        encoder.resolve_query_set(&set, 0..count, &resolved, 0);
        let readable = self.readable(bytes);
        encoder.copy_buffer_to_buffer(&resolved, 0, &readable, 0, bytes);
        self.queue.submit([encoder.finish()]);
        let data = self.read(&[(&readable, bytes)])?;
        let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&data[0]);
        let tick_ms = f64::from(self.queue.get_timestamp_period()) * 1e-6;
        let times = ticks.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64 * tick_ms);
        Ok(ops.iter().zip(times).map(|(op, ms)| CommandTime { name: op.name(), ms }).collect())
    }
}
