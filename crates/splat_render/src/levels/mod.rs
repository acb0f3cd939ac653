//! Scenes in levels of detail, for viewing scenes larger than memory: PlayCanvas's streamed SOG, version
//! 1.
//!
//! A folder has a `lod-meta.json` ([`Manifest`]) and SOGs in folders. Space is split into cells; each has
//! its splats at several levels, 0 the finest. [`write_levels`] writes such a folder in bounded memory,
//! [`choose`] selects the level of each cell for a camera within a budget of splats, and [`Resident`]
//! holds the loaded splats.

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
