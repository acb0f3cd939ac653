//! Reads models in threads, while the window goes on drawing.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};

use splat_render::Result;

use crate::model::Model;
use crate::sources::{Stamp, stamp};

/// A model that was read, or the error.
#[derive(Debug)]
pub struct Loaded {
    /// The side it is for, 0 or 1.
    pub side: usize,
    pub path: PathBuf,
    /// The file's stamp before it was read.
    pub stamp: Option<Stamp>,
    pub model: Result<Model>,
}

/// Models being read, one at a time for each side.
#[derive(Debug)]
pub struct Loader {
    sender: Sender<Loaded>,
    receiver: Receiver<Loaded>,
    /// The file that each side waits for.
    waits: [Option<PathBuf>; 2],
    budget: Option<usize>,
}

impl Loader {
    pub fn new(budget: Option<usize>) -> Self {
        let (sender, receiver) = channel();
        Self { sender, receiver, waits: [None, None], budget }
    }

    pub fn is_busy(&self, side: usize) -> bool {
        self.waits[side].is_some()
    }

    /// Reads a file for a side; `wake` is called when it is there.
    pub fn load(&mut self, side: usize, path: &Path, wake: impl FnOnce() + Send + 'static) {
        self.waits[side] = Some(path.to_owned());
        let (path, sender, budget) = (path.to_owned(), self.sender.clone(), self.budget);
        std::thread::spawn(move || {
            let stamp = stamp(&path);
            let model = Model::read(&path, budget);
            // The receiver is gone once the window is closed.
            let _ = sender.send(Loaded { side, path, stamp, model });
            wake();
        });
    }

    /// Drops the pending read for a side: it will not be shown.
    pub fn forget(&mut self, side: usize) {
        self.waits[side] = None;
    }

    /// The next model that was read and is still wanted.
    pub fn next(&mut self) -> Option<Loaded> {
        loop {
            let loaded = self.receiver.try_recv().ok()?;
            if self.waits[loaded.side].as_ref() == Some(&loaded.path) {
                self.waits[loaded.side] = None;
                return Some(loaded);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_removed_while_it_is_read_is_not_shown() {
        let mut loader = Loader::new(None);
        let (there, done) = channel();
        for (side, name) in [(1, "no such file"), (0, "nor this")] {
            let there = there.clone();
            loader.load(side, Path::new(name), move || there.send(()).expect("a test waits"));
            if side == 1 {
                loader.forget(side);
                assert!(!loader.is_busy(side));
            }
        }
        for _ in 0..2 {
            done.recv().expect("both are read");
        }
        assert_eq!(loader.next().expect("the other side's").side, 0);
        assert!(loader.next().is_none());
    }
}
