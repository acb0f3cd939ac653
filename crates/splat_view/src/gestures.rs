//! Drags, wheel, touches and keys to movements of the camera.

use egui::{Event, Key, PointerButton, Response, Ui};

use crate::display::Display;
use crate::viewer::{Action, Moving, Viewer};

/// Radians for a point of a drag.
const TURN: f64 = 0.005;
/// Radians in a second for arrow keys.
const TURN_KEYS: f64 = 1.2;
/// Zoom, as a logarithm, for a point of the wheel; a notch has about 40.
const WHEEL: f64 = 0.002;
/// Distances to the pivot that keys move in a second.
const SPEED: f64 = 0.8;
/// What Shift makes of it.
const FAST: f64 = 4.0;
/// Longest time that a key's movement counts for: after a pause nothing jumps.
const LONGEST: f32 = 0.1;

/// Moves the camera as the pointer says. `size` is the picture's, `scale` pixels per point.
pub fn pointer(
    viewer: &mut Viewer,
    ui: &Ui,
    response: &Response,
    size: [u32; 2],
    actions: &mut Vec<Action>,
) {
    let scale = ui.ctx().pixels_per_point();
    let before = viewer.viewpoint;
    let mut moved = before;
    let camera = viewer.camera(size);
    // World units at the pivot for a point of a drag.
    let reach = f64::from(scale) * moved.distance / camera.fy;
    let touch = ui.input(|i| i.multi_touch());
    let delta = ui.input(|i| i.pointer.delta());
    let (dx, dy) = (f64::from(delta.x), f64::from(delta.y));
    if let Some(touch) = touch {
        let shift = touch.translation_delta;
        moved.pan(f64::from(shift.x) * reach, f64::from(shift.y) * reach);
    } else if response.dragged() || response.drag_stopped() {
        let with_shift = ui.input(|i| i.modifiers.shift);
        // The frame in which a button is let go has the drag's last movement.
        let by = |button| response.dragged_by(button) || response.drag_stopped_by(button);
        if by(PointerButton::Secondary)
            || by(PointerButton::Middle)
            || (by(PointerButton::Primary) && with_shift)
        {
            moved.pan(dx * reach, dy * reach);
        } else if by(PointerButton::Primary) {
            match viewer.moving {
                Moving::Orbit => moved.orbit(dx * TURN, -dy * TURN, viewer.up),
                Moving::Fly | Moving::FirstPerson => {
                    moved.turn(dx * TURN, -dy * TURN, viewer.up);
                }
            }
        }
    }
    if response.hovered() {
        let (wheel, pinch) = ui.input(|i| (i.smooth_scroll_delta().y, i.zoom_delta()));
        let factor = (f64::from(wheel) * WHEEL).exp() * f64::from(pinch);
        if factor != 1.0 && factor.is_finite() && factor > 0.0 {
            match viewer.moving {
                Moving::Orbit => moved.zoom(factor),
                Moving::Fly | Moving::FirstPerson => {
                    moved.position += moved.forward() * factor.ln() * moved.distance;
                }
            }
        }
    }
    if let Some(at) = response.interact_pointer_pos().filter(|_| response.double_clicked()) {
        let pixel = [at.x * scale, at.y * scale];
        let inside = |p: f32, side: u32| (p.max(0.0) as u32).min(side - 1);
        actions.push(Action::Focus([inside(pixel[0], size[0]), inside(pixel[1], size[1])]));
    }
    if moved != before {
        viewer.leave_camera(size);
        viewer.viewpoint = moved;
    }
}

/// Moves the camera and changes settings as keys say.
pub fn keys(viewer: &mut Viewer, ui: &Ui, size: [u32; 2], actions: &mut Vec<Action>) {
    if ui.ctx().egui_wants_keyboard_input() {
        return;
    }
    let before = viewer.viewpoint;
    let mut moved = before;
    let (steps, turns, is_fast, seconds, is_plain) = ui.input(|i| {
        // -1, 0 or 1 as the first, none or the second of two keys is down.
        let pair = |less, more| f64::from(i8::from(i.key_down(more)) - i8::from(i.key_down(less)));
        (
            [pair(Key::A, Key::D), pair(Key::Q, Key::E), pair(Key::S, Key::W)],
            [pair(Key::ArrowLeft, Key::ArrowRight), pair(Key::ArrowDown, Key::ArrowUp)],
            i.modifiers.shift,
            f64::from(i.stable_dt.min(LONGEST)),
            !i.modifiers.command && !i.modifiers.alt,
        )
    });
    if !is_plain {
        return;
    }
    if steps != [0.0; 3] || turns != [0.0; 2] {
        let speed = seconds * SPEED * moved.distance * if is_fast { FAST } else { 1.0 };
        let (right, up, ahead) = match viewer.moving {
            Moving::FirstPerson => {
                let right = moved.right();
                (right, viewer.up, viewer.up.cross(right).normalize_or(moved.forward()))
            }
            Moving::Orbit | Moving::Fly => (moved.right(), -moved.down(), moved.forward()),
        };
        moved.position += (right * steps[0] + up * steps[1] + ahead * steps[2]) * speed;
        let [yaw, pitch] = turns.map(|turn| turn * TURN_KEYS * seconds);
        match viewer.moving {
            Moving::Orbit => moved.orbit(-yaw, -pitch, viewer.up),
            Moving::Fly | Moving::FirstPerson => moved.turn(yaw, pitch, viewer.up),
        }
        // Held keys go on.
        ui.ctx().request_repaint();
    }
    if moved != before {
        viewer.leave_camera(size);
        viewer.viewpoint = moved;
    }
    let pressed = |key| ui.input(|i| i.key_pressed(key));
    let digits = [Key::Num1, Key::Num2, Key::Num3, Key::Num4, Key::Num5];
    for (key, (display, _)) in digits.into_iter().zip(Display::ALL) {
        if pressed(key) {
            viewer.settings.display = display;
        }
    }
    if pressed(Key::V) {
        let at = Moving::ALL.iter().position(|(moving, _)| *moving == viewer.moving).unwrap_or(0);
        let (moving, name) = Moving::ALL[(at + 1) % Moving::ALL.len()];
        (viewer.moving, viewer.message) = (moving, name.to_owned());
    }
    if pressed(Key::H) {
        viewer.shows_panel = !viewer.shows_panel;
    }
    if pressed(Key::C) {
        viewer.shows_cameras = !viewer.shows_cameras;
    }
    if pressed(Key::K) {
        viewer.path.keys.push(viewer.viewpoint);
    }
    if pressed(Key::F) {
        actions.push(Action::Frame);
    }
    // With the modifiers of that very press: Shift may be up again before the frame.
    let with_shift = ui.input(|i| {
        i.events.iter().find_map(|event| match event {
            Event::Key { key: Key::P, pressed: true, repeat: false, modifiers, .. } => {
                Some(modifiers.shift)
            }
            _ => None,
        })
    });
    if let Some(with_shift) = with_shift {
        actions.push(if with_shift { Action::SaveExr } else { Action::Screenshot });
    }
    if pressed(Key::R) {
        actions.push(Action::Record);
    }
    if pressed(Key::Escape) {
        actions.push(Action::StopRecording);
    }
    let count = viewer.cameras.len();
    let next = |step: usize| viewer.at_camera.map_or(0, |at| (at + step) % count);
    if count > 0 && pressed(Key::CloseBracket) {
        actions.push(Action::Jump(next(1)));
    }
    if count > 0 && pressed(Key::OpenBracket) {
        actions.push(Action::Jump(next(count - 1)));
    }
}
