//! Follows the view of a scene in levels of detail: a thread reads splats while the window draws.

use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::time::{Duration, Instant};

use splat_render::Result;
use splat_render::levels::{Choice, Drawn, View};

use crate::detail::Detail;

/// Interval at which loaded splats are shown during reading.
const SHOWN_EVERY: Duration = Duration::from_millis(300);

/// A thread that follows a view; it ends when this goes.
#[derive(Debug)]
pub struct Streaming {
    views: Sender<View>,
    drawn: Receiver<Result<Drawn>>,
    last: Option<View>,
}

impl Streaming {
    /// Starts it; `wake` is called when there is something new to draw.
    pub fn start(detail: Detail, wake: impl Fn() + Send + 'static) -> Self {
        let (views, asked) = channel();
        // One waits at most, so that no more copies than that are in memory.
        let (answers, drawn) = sync_channel(1);
        std::thread::spawn(move || follow(detail, &asked, &Answers { answers, wake }));
        Self { views, drawn, last: None }
    }

    pub fn look(&mut self, view: View) {
        if self.last != Some(view) {
            self.last = Some(view);
            // The thread lives as long as this.
            let _ = self.views.send(view);
        }
    }

    /// The next picture's splats, or why some cannot be read.
    pub fn next(&mut self) -> Option<Result<Drawn>> {
        self.drawn.try_recv().ok()
    }
}

struct Answers<F> {
    answers: SyncSender<Result<Drawn>>,
    wake: F,
}

impl<F: Fn()> Answers<F> {
    /// False once the receiver is gone.
    fn tell(&self, answer: Result<Drawn>) -> bool {
        let is_heard = self.answers.send(answer).is_ok();
        (self.wake)();
        is_heard
    }
}

fn follow<F: Fn()>(mut detail: Detail, views: &Receiver<View>, answers: &Answers<F>) {
    let mut shown: Option<Choice> = None;
    let mut told = Instant::now();
    while let Ok(mut view) = views.recv() {
        loop {
            view = views.try_iter().last().unwrap_or(view);
            let choice = detail.choose(&view);
            let mut is_new = shown.as_ref() != Some(&choice);
            let mut newer = None;
            while let Some(loaded) = detail.load_next(&choice) {
                is_new = true;
                if let Err(error) = loaded
                    && !answers.tell(Err(error))
                {
                    return;
                }
                if told.elapsed() >= SHOWN_EVERY {
                    if !answers.tell(Ok(detail.drawn(&choice))) {
                        return;
                    }
                    told = Instant::now();
                }
                newer = views.try_iter().last();
                if newer.is_some() {
                    break;
                }
            }
            if let Some(newer) = newer {
                view = newer;
                continue;
            }
            if is_new && !answers.tell(Ok(detail.drawn(&choice))) {
                return;
            }
            told = Instant::now();
            shown = Some(choice);
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use glam::{DMat4, DVec3};
    use splat_render::Camera;
    use splat_render::fit::SplatArrays;
    use splat_render::io::{SplatFile, write_splats};
    use splat_render::levels::write_levels;

    use super::*;
    use crate::detail::view;

    /// Two thousand splats in a row along x, in cells of 100 at three levels.
    fn levels(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("splat-view-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(folder.join("levels")).expect("folder");
        let n = 2000;
        let splats = SplatArrays {
            means: (0..n).map(|i| [0.01 * i as f32, 0.0, 0.0]).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[-5.0; 3]; n],
            opacities: vec![1.0; n],
            sh: vec![[0.5; 3]; n],
            sh_degree: 0,
        };
        let file = SplatFile { splats, ..SplatFile::default() };
        write_splats(&folder.join("scene.ply"), &file).expect("a scene");
        let levels = folder.join("levels");
        write_levels(&folder.join("scene.ply"), &levels, 3, 100, &mut || true).expect("levels");
        folder
    }

    fn camera(x: f64) -> Camera {
        let viewmat = DMat4::from_translation(DVec3::new(-x, 0.0, 0.5));
        Camera { viewmat, fx: 500.0, fy: 500.0, cx: 50.0, cy: 50.0, width: 100, height: 100 }
    }

    /// Splats of the last answer to a view, which nothing more is loaded for.
    fn settled(streaming: &mut Streaming, woken: &Receiver<()>) -> Drawn {
        loop {
            woken.recv_timeout(Duration::from_secs(60)).expect("an answer");
            while let Some(drawn) = streaming.next() {
                let drawn = drawn.expect("levels");
                assert!(drawn.file.splats.len() <= 600);
                if drawn.waiting == 0 {
                    return drawn;
                }
            }
        }
    }

    #[test]
    fn near_cells_are_fine_within_the_budget() {
        let folder = levels("follow");
        let (detail, coarse) =
            Detail::open(&folder.join("levels/lod-meta.json"), 600).expect("open");
        assert!(coarse.splats.len() < 200);
        let (wake, woken) = channel();
        let mut streaming = Streaming::start(detail, move || {
            let _ = wake.send(());
        });
        for x in [3.0, 17.0, 3.0] {
            streaming.look(view(&camera(x), 0.01));
            let drawn = settled(&mut streaming, &woken);
            let near = |a: &[f32; 3]| (f64::from(a[0]) - x).abs() < 0.3;
            let fine = drawn.file.splats.means.iter().filter(|mean| near(mean)).count();
            assert!(fine >= 58, "{fine} of 60 near {x}");
        }
        std::fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn a_deleted_file_is_reported_once_and_the_rest_is_drawn() {
        let folder = levels("gone");
        let (detail, _) = Detail::open(&folder.join("levels/lod-meta.json"), 600).expect("open");
        for entry in std::fs::read_dir(folder.join("levels")).expect("folder").flatten() {
            if entry.file_name().to_string_lossy().starts_with("0_") {
                std::fs::remove_dir_all(entry.path()).expect("gone");
            }
        }
        let (wake, woken) = channel();
        let mut streaming = Streaming::start(detail, move || {
            let _ = wake.send(());
        });
        streaming.look(view(&camera(3.0), 0.01));
        let (mut errors, mut drawn) = (Vec::new(), None);
        while drawn.is_none() {
            woken.recv_timeout(Duration::from_secs(60)).expect("an answer");
            while let Some(answer) = streaming.next() {
                match answer {
                    Ok(one) => drawn = Some(one),
                    Err(error) => errors.push(error.to_string()),
                }
            }
        }
        assert!(!errors.is_empty() && errors.iter().all(|e| e.contains("meta.json")), "{errors:?}");
        assert!(drawn.is_some_and(|drawn| drawn.waiting > 0 && !drawn.file.splats.is_empty()));
        std::fs::remove_dir_all(folder).expect("clean");
    }
}
