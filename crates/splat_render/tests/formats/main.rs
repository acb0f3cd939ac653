//! Splat files of every format: what comes back, what is said, and what damage does.

mod hostile;
mod layouts;
mod memory;
mod mutations;
mod notes;
mod round_trips;
mod scenes;
