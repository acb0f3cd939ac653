//! Scenes in levels of detail, so that what is larger than memory can be looked at: PlayCanvas's streamed
//! SOG, version 1.
//!
//! A folder has a `lod-meta.json` ([`Manifest`]) and SOGs in folders. Space is split into cells; each has
//! its splats at several levels, 0 the finest. [`write_levels`] makes such a folder in bounded memory,
//! [`choose`] says which level of each cell a camera needs within a budget of splats, and [`Resident`]
//! holds those that were read.

mod cells;
mod choice;
mod manifest;
mod merging;
mod resident;
mod symmetric;
mod write;

pub use choice::{Choice, View, choose, coarsest};
pub use manifest::{Cell, INDEX, Manifest, Run};
pub use resident::{Drawn, Resident, read_within};
pub use write::{LevelsWritten, write_levels};
