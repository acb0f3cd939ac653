//! Which renderer draws faster here, by the times of a window's first frames.

/// Frames of each renderer that are timed; the first compiles and makes room.
pub const TIMED: usize = 4;

/// Least milliseconds of a renderer's timed frames.
#[derive(Debug, Clone, Copy)]
struct Timed {
    frames: usize,
    least: f32,
}

const UNTIMED: Timed = Timed { frames: 0, least: f32::INFINITY };

/// Times both renderers, and again when the number of splats or pixels doubles or halves.
#[derive(Debug)]
pub struct DrawingChoice {
    /// The splats and pixels for which the times hold.
    work: [u32; 2],
    has_memory: bool,
    blending: Timed,
    rasterizer: Timed,
}

impl DrawingChoice {
    pub fn new() -> Self {
        Self { work: [0; 2], has_memory: true, blending: UNTIMED, rasterizer: UNTIMED }
    }

    /// Whether the rasterizer draws the next frame. Blending goes first, and on without times.
    pub fn rasterizes(&mut self, splats: u32, pixels: u32) -> bool {
        let work = [splats, pixels];
        let is_other = |(now, before): (u32, u32)| now / 2 >= before || before / 2 >= now;
        if work.into_iter().zip(self.work).any(is_other) {
            *self = Self { work, ..Self::new() };
        }
        if self.blending.frames < TIMED || !self.has_memory {
            return false;
        }
        self.rasterizer.frames < TIMED || self.rasterizer.least < self.blending.least
    }

    /// Takes in the time of a frame.
    pub fn timed(&mut self, is_rasterized: bool, milliseconds: f32) {
        let timed = if is_rasterized { &mut self.rasterizer } else { &mut self.blending };
        timed.frames += 1;
        if timed.frames > 1 {
            timed.least = timed.least.min(milliseconds);
        }
    }

    /// Leaves the drawing to blending: the rasterizer lacks memory.
    pub fn rule_out_rasterizer(&mut self) {
        self.has_memory = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Draws frames that take `blend` or `rasterize` milliseconds; how many the rasterizer drew.
    fn drawn(choice: &mut DrawingChoice, frames: usize, blend: f32, rasterize: f32) -> usize {
        let mut rasterized = 0;
        for _ in 0..frames {
            let is_rasterized = choice.rasterizes(1000, 5000);
            choice.timed(is_rasterized, if is_rasterized { rasterize } else { blend });
            rasterized += usize::from(is_rasterized);
        }
        rasterized
    }

    #[test]
    fn the_faster_renderer_draws_once_both_are_timed() {
        let mut choice = DrawingChoice::new();
        assert_eq!(drawn(&mut choice, 20, 3.0, 1.0), 20 - TIMED);
        let mut choice = DrawingChoice::new();
        assert_eq!(drawn(&mut choice, 20, 1.0, 3.0), TIMED);
    }

    #[test]
    fn first_frames_do_not_decide() {
        let mut choice = DrawingChoice::new();
        assert!(!choice.rasterizes(1000, 5000));
        choice.timed(false, 0.1);
        assert_eq!(drawn(&mut choice, 20, 3.0, 1.0), 20 - (TIMED - 1));
    }

    #[test]
    fn much_more_work_is_timed_again() {
        let mut choice = DrawingChoice::new();
        drawn(&mut choice, 20, 3.0, 1.0);
        assert!(choice.rasterizes(1990, 5000));
        assert!(!choice.rasterizes(2000, 5000));
        drawn(&mut choice, 20, 3.0, 1.0);
        assert!(choice.rasterizes(501, 5000));
        assert!(!choice.rasterizes(1000, 10_000));
    }

    #[test]
    fn without_times_or_memory_blending_draws() {
        let mut choice = DrawingChoice::new();
        assert!((0..20).all(|_| !choice.rasterizes(1000, 5000)));
        drawn(&mut choice, TIMED, 3.0, 1.0);
        assert!(choice.rasterizes(1000, 5000));
        choice.rule_out_rasterizer();
        choice.timed(true, 0.1);
        assert!(!choice.rasterizes(1000, 5000));
    }
}
