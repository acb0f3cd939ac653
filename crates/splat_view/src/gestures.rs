//! Drags, wheel, touches and keys move the camera.

use egui::{Event, Key, PointerButton, Response, Ui};

use crate::display::Display;
use crate::viewer::{Action, Moving, Viewer};

/// Radians per point of a drag.
const TURN: f64 = 0.005;
/// Radians per second for arrow keys.
const TURN_KEYS: f64 = 1.2;
/// Logarithm of the zoom factor per point of the wheel; a notch has about 40.
const WHEEL: f64 = 0.002;
/// Speed of keys, in distances to the pivot per second.
const SPEED: f64 = 0.8;
/// Factor of the speed with Shift.
const FAST: f64 = 4.0;
/// Longest time in seconds that one movement by key covers: nothing jumps after a pause.
const KEY_STEP_MAX: f32 = 0.1;

/// Moves the camera by the pointer. `size` is the picture's, in pixels.
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
    // World units at the pivot per point of a drag.
    let reach = f64::from(scale) * moved.distance / camera.fy;
    // Touches that began on the panel belong to the panel.
    let touch = ui.input(|i| i.multi_touch()).filter(|_| response.is_pointer_button_down_on());
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

/// Moves the camera and changes settings by keys.
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
            f64::from(i.stable_dt.min(KEY_STEP_MAX)),
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
        // Held keys move on in the next frame.
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
        viewer.moving = moving;
        viewer.notes.tell_state(name);
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
    let count = viewer.cameras.len();
    let next = |step: usize| viewer.at_camera.map_or(0, |at| (at + step) % count);
    if count > 0 && pressed(Key::CloseBracket) {
        actions.push(Action::Jump(next(1)));
    }
    if count > 0 && pressed(Key::OpenBracket) {
        actions.push(Action::Jump(next(count - 1)));
    }
    // After all that changes the view, which may come in the same frame on a slow device.
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
}

#[cfg(test)]
mod tests {
    use egui::{
        CentralPanel, Id, Panel, Pos2, RawInput, Rect, Sense, TouchDeviceId, TouchId, TouchPhase,
    };
    use egui::{Context, Modifiers, Vec2, pos2};

    use super::*;
    use crate::display::Settings;
    use crate::viewpoint::Viewpoint;

    const SIZE: [u32; 2] = [400, 300];

    /// A window of points as large as pixels, without the window.
    struct Hand {
        context: Context,
        viewer: Viewer,
        time: f64,
    }

    impl Hand {
        fn new() -> Self {
            let mut viewer = Viewer::new(Settings::default(), String::new());
            viewer.viewpoint = Viewpoint::framing(glam::DVec3::ZERO, 1.0, viewer.up, 1.0);
            let mut hand = Self { context: Context::default(), viewer, time: 0.0 };
            // egui hit-tests against the previous frame.
            hand.frame(Vec::new());
            hand
        }

        fn frame(&mut self, events: Vec<Event>) -> Vec<Action> {
            self.time += 0.02;
            let mut actions = Vec::new();
            let input = RawInput {
                screen_rect: Some(Rect::from_min_size(Pos2::ZERO, Vec2::new(400.0, 300.0))),
                time: Some(self.time),
                events,
                ..RawInput::default()
            };
            let viewer = &mut self.viewer;
            let mut output = self.context.run_ui(input, |ui| {
                Panel::right("panel").exact_size(100.0).show(ui, |ui| {
                    ui.interact(ui.max_rect(), Id::unique("list"), Sense::click_and_drag());
                });
                CentralPanel::no_frame().show(ui, |ui| {
                    let all = ui.max_rect();
                    let response = ui.interact(all, Id::unique("splats"), Sense::click_and_drag());
                    pointer(viewer, ui, &response, SIZE, &mut actions);
                    keys(viewer, ui, SIZE, &mut actions);
                });
            });
            // Nothing is painted here: egui asks that its textures are then dropped by name.
            output.textures_delta.clear();
            actions
        }

        /// Finger events as egui-winit sends them, one after another: the first finger is a mouse, too.
        fn fingers(&mut self, phase: TouchPhase, places: &[Pos2]) {
            if phase == TouchPhase::Start && places.len() > 1 {
                self.fingers(phase, &places[..1]);
            }
            let button = |pressed| Event::PointerButton {
                pos: places[0],
                button: PointerButton::Primary,
                pressed,
                modifiers: Modifiers::NONE,
            };
            let mut events = Vec::new();
            let is_second = phase == TouchPhase::Start && places.len() > 1;
            for (id, &pos) in places.iter().enumerate().skip(usize::from(is_second)) {
                let (device_id, id) = (TouchDeviceId(0), TouchId(id as u64));
                events.push(Event::Touch { device_id, id, phase, pos, force: None });
            }
            match phase {
                TouchPhase::Start if is_second => {}
                TouchPhase::Start => events.extend([Event::PointerMoved(places[0]), button(true)]),
                TouchPhase::Move => events.push(Event::PointerMoved(places[0])),
                _ => events.extend([button(false), Event::PointerGone]),
            }
            self.frame(events);
        }
    }

    /// Pixel of a point of the world.
    fn seen(viewpoint: &Viewpoint, point: glam::DVec3) -> [f64; 2] {
        let camera = viewpoint.camera(SIZE, Settings::default().fov);
        let p = camera.viewmat.transform_point3(point);
        [camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy]
    }

    #[test]
    fn one_finger_turns_and_two_pan() {
        let mut hand = Hand::new();
        let before = hand.viewer.viewpoint;
        let at = |x: f32, y: f32| pos2(x, y);
        hand.fingers(TouchPhase::Start, &[at(100.0, 100.0)]);
        for step in 1..=5 {
            hand.fingers(TouchPhase::Move, &[at(100.0 + 8.0 * step as f32, 100.0)]);
        }
        hand.fingers(TouchPhase::End, &[at(140.0, 100.0)]);
        let turned = hand.viewer.viewpoint;
        let angle = before.forward().angle_between(turned.forward());
        assert!((angle - 40.0 * TURN).abs() < 0.05, "one finger turned by {angle}");
        assert!(turned.pivot().distance(before.pivot()) < 1e-9, "one finger moved the middle");

        hand.fingers(TouchPhase::Start, &[at(100.0, 100.0), at(200.0, 100.0)]);
        for step in 1..=5 {
            let (x, y) = (10.0 * step as f32, 6.0 * step as f32);
            hand.fingers(TouchPhase::Move, &[at(100.0 + x, 100.0 + y), at(200.0 + x, 100.0 + y)]);
        }
        hand.fingers(TouchPhase::End, &[at(150.0, 130.0), at(250.0, 130.0)]);
        let panned = hand.viewer.viewpoint;
        let (from, to) = (seen(&turned, turned.pivot()), seen(&panned, turned.pivot()));
        assert!((to[0] - from[0] - 50.0).abs() < 1.0, "{from:?} {to:?}");
        assert!((to[1] - from[1] - 30.0).abs() < 1.0, "{from:?} {to:?}");
        assert!((panned.distance / turned.distance - 1.0).abs() < 1e-6, "a pan does not zoom");
        assert!(panned.forward().distance(turned.forward()) < 1e-9, "a pan does not rotate");
    }

    #[test]
    fn fingers_on_the_panel_do_not_move_the_camera() {
        let mut hand = Hand::new();
        let before = hand.viewer.viewpoint;
        hand.fingers(TouchPhase::Start, &[pos2(350.0, 100.0), pos2(350.0, 140.0)]);
        for step in 1..=5 {
            let y = 10.0 * step as f32;
            hand.fingers(TouchPhase::Move, &[pos2(350.0, 100.0), pos2(350.0, 140.0 + y)]);
        }
        hand.fingers(TouchPhase::End, &[pos2(350.0, 100.0), pos2(350.0, 190.0)]);
        assert_eq!(hand.viewer.viewpoint, before);
    }

    #[test]
    fn pinches_and_the_wheel_zoom() {
        let mut hand = Hand::new();
        let before = hand.viewer.viewpoint;
        let apart = |half: f32| [pos2(200.0 - half, 150.0), pos2(200.0 + half, 150.0)];
        hand.fingers(TouchPhase::Start, &apart(40.0));
        for step in 1..=5 {
            hand.fingers(TouchPhase::Move, &apart(40.0 + 8.0 * step as f32));
        }
        hand.fingers(TouchPhase::End, &apart(80.0));
        let nearer = hand.viewer.viewpoint;
        assert!((before.distance / nearer.distance - 2.0).abs() < 0.02, "{}", nearer.distance);
        assert!(nearer.pivot().distance(before.pivot()) < 1e-9, "the middle moved");

        // A pinch on a touch pad.
        hand.frame(vec![Event::PointerMoved(pos2(200.0, 150.0))]);
        hand.frame(vec![Event::Zoom(0.5)]);
        let farther = hand.viewer.viewpoint;
        assert!((farther.distance / nearer.distance - 2.0).abs() < 1e-6, "{}", farther.distance);
        hand.frame(vec![Event::MouseWheel {
            unit: egui::MouseWheelUnit::Line,
            source: egui::MouseWheelSource::Wheel,
            delta: Vec2::new(0.0, 1.0),
            phase: TouchPhase::Move,
            modifiers: Modifiers::NONE,
        }]);
        for _ in 0..30 {
            hand.frame(Vec::new());
        }
        let notch = farther.distance / hand.viewer.viewpoint.distance;
        assert!((1.02..1.2).contains(&notch), "a notch of the wheel zooms by {notch}");
        // In flight the same goes ahead, and the middle with it.
        hand.viewer.moving = Moving::Fly;
        let still = hand.viewer.viewpoint;
        hand.frame(vec![Event::Zoom(1.5)]);
        let ahead = (hand.viewer.viewpoint.position - still.position).dot(still.forward());
        assert!(ahead > 0.0 && hand.viewer.viewpoint.distance == still.distance, "{ahead}");
    }
}
