//! Splat files of every format: round trips, notes, and damage.

mod hostile;
mod layouts;
mod levels;
mod memory;
mod mutations;
mod notes;
mod round_trips;
mod scenes;
