//! Reads the command line's files before a window opens, so that errors are printed.

use std::path::PathBuf;

use splat_render::{Error, Result};

use crate::arguments::Arguments;
use crate::detail::is_in_levels;
use crate::model::Model;
use crate::sources::{Source, find_sources};

pub struct Start {
    /// The models that can be chosen.
    pub sources: Vec<Source>,
    /// The first folder that was named; it is watched.
    pub folder: Option<PathBuf>,
    pub models: Vec<(Source, Model)>,
}

impl Start {
    pub fn read(arguments: &Arguments) -> Result<Self> {
        let mut out = Self { sources: Vec::new(), folder: None, models: Vec::new() };
        for scene in &arguments.scenes {
            let found = find_sources(scene)?;
            if scene.is_dir() {
                out.folder.get_or_insert_with(|| scene.clone());
            }
            if out.models.len() < 2 {
                let model = Model::read(&found[0].path, arguments.budget)?;
                out.models.push((found[0].clone(), model));
            }
            out.sources.extend(found);
        }
        let has_levels = out.sources.iter().any(|source| is_in_levels(&source.path));
        if arguments.budget.is_some() && !arguments.scenes.is_empty() && !has_levels {
            return Err(no_levels());
        }
        Ok(out)
    }
}

/// The error of a budget for a scene that is drawn whole.
pub fn no_levels() -> Error {
    Error::argument(
        "--budget",
        "is for scenes in levels of detail; write one with igsr convert --lod, or leave it out",
    )
}
