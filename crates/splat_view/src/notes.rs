//! Messages in the window, newest last. A note does not replace another: both can be read.

use std::time::{Duration, Instant};

/// Most notes at a time.
const NOTES_MAX: usize = 6;
/// How long a note stays at least once others follow.
const SHOWN_FOR: Duration = Duration::from_secs(60);

#[derive(Debug, Clone)]
struct Note {
    text: String,
    since: Instant,
    /// Whether it describes the current view; the next such note replaces it.
    is_state: bool,
}

#[derive(Debug, Clone, Default)]
pub struct Notes(Vec<Note>);

impl Notes {
    /// Shows a result, a warning or an error. Empty texts are ignored.
    pub fn show(&mut self, text: impl Into<String>) {
        self.push(text.into(), false, Instant::now());
    }

    /// Shows the state of the view in place of the previous state.
    pub fn tell_state(&mut self, text: impl Into<String>) {
        self.0.retain(|note| !note.is_state);
        self.push(text.into(), true, Instant::now());
    }

    pub fn has(&self, text: &str) -> bool {
        self.0.iter().any(|note| note.text == text)
    }

    /// The texts, newest last.
    pub fn texts(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|note| note.text.as_str())
    }

    fn push(&mut self, text: String, is_state: bool, now: Instant) {
        if text.is_empty() {
            return;
        }
        self.0.retain(|note| note.text != text && now.duration_since(note.since) < SHOWN_FOR);
        if self.0.len() == NOTES_MAX {
            self.0.remove(0);
        }
        self.0.push(Note { text, since: now, is_state });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(notes: &Notes) -> Vec<&str> {
        notes.texts().collect()
    }

    #[test]
    fn notes_queue_and_states_replace_each_other() {
        let mut notes = Notes::default();
        notes.show("3 of 103 splats are broken.");
        notes.show("cameras.json: is damaged");
        notes.tell_state("Camera 0: a.png");
        notes.show("");
        notes.tell_state("Camera 1: b.png");
        assert_eq!(
            texts(&notes),
            ["3 of 103 splats are broken.", "cameras.json: is damaged", "Camera 1: b.png"]
        );
        assert!(notes.has("cameras.json: is damaged") && !notes.has("Camera 0: a.png"));
        // Said again, it is the newest, and once.
        notes.show("3 of 103 splats are broken.");
        assert_eq!(texts(&notes).len(), 3);
        assert_eq!(texts(&notes).last(), Some(&"3 of 103 splats are broken."));
    }

    #[test]
    fn the_oldest_go_first_by_number_and_by_age() {
        let (mut notes, now) = (Notes::default(), Instant::now());
        for number in 0..=NOTES_MAX {
            notes.push(format!("note {number}"), false, now);
        }
        assert_eq!(texts(&notes).len(), NOTES_MAX);
        assert_eq!(texts(&notes)[0], "note 1");
        // However old, the last note stays until another follows.
        notes.push("late".to_owned(), false, now + SHOWN_FOR);
        assert_eq!(texts(&notes), ["late"]);
    }
}
