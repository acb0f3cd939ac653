//! Painted over the splats: the capture's cameras, a photo, the divider.

use egui::{Align2, Color32, FontId, Pos2, Rect, Stroke, TextureHandle, Ui};
use glam::DVec3;
use splat_render::Camera;

use crate::viewer::{Action, Viewer};

/// Half the width of the divider's grip, in points.
const GRIP: f32 = 6.0;
/// Farthest click from a camera's place that selects it, in points.
const NEAR: f32 = 10.0;
/// Length of a frustum as a fraction of the scene's radius.
const FRUSTUM: f64 = 0.12;

/// A point of the world in points of the window; None behind the camera.
fn project(camera: &Camera, scale: f32, point: DVec3) -> Option<Pos2> {
    let p = camera.viewmat.transform_point3(point);
    if p.z <= 1e-6 {
        return None;
    }
    let x = camera.fx * p.x / p.z + camera.cx;
    let y = camera.fy * p.y / p.z + camera.cy;
    Some(Pos2::new(x as f32 / scale, y as f32 / scale))
}

/// Paints the capture's cameras; a click on one, at `clicked`, moves the view to it.
pub fn cameras(
    viewer: &Viewer,
    ui: &Ui,
    size: [u32; 2],
    clicked: Option<Pos2>,
    actions: &mut Vec<Action>,
) {
    if !viewer.shows_cameras {
        return;
    }
    let scale = ui.ctx().pixels_per_point();
    let camera = viewer.camera(size);
    let length = FRUSTUM * viewer.extent().1;
    for (number, other) in viewer.cameras.iter().enumerate() {
        if viewer.at_camera == Some(number) {
            continue;
        }
        let other = &other.camera;
        let to_world = other.viewmat.inverse();
        let (w, h) = (f64::from(other.width), f64::from(other.height));
        let corner = |x: f64, y: f64| {
            let ray = DVec3::new((x - other.cx) / other.fx, (y - other.cy) / other.fy, 1.0);
            project(&camera, scale, to_world.transform_point3(ray * length))
        };
        let Some(place) = project(&camera, scale, other.center()) else { continue };
        let corners = [corner(0.0, 0.0), corner(w, 0.0), corner(w, h), corner(0.0, h)];
        // The upper edge is marked: it shows how the camera is rolled.
        let upper = Stroke::new(2.0, Color32::from_rgb(255, 170, 60));
        let line = Stroke::new(1.0, Color32::from_rgb(120, 190, 255));
        for (i, corner) in corners.iter().enumerate() {
            let (Some(from), next) = (corner, corners[(i + 1) % 4]) else { continue };
            ui.painter().line_segment([place, *from], line);
            if let Some(to) = next {
                ui.painter().line_segment([*from, to], if i == 0 { upper } else { line });
            }
        }
        ui.painter().circle_filled(place, 2.5, line.color);
        if clicked.is_some_and(|at| at.distance(place) < NEAR) {
            actions.push(Action::Jump(number));
        }
    }
}

pub fn photo(viewer: &Viewer, ui: &Ui, size: [u32; 2], texture: &TextureHandle) {
    let Some(at) = viewer.at_camera.and_then(|i| viewer.cameras.get(i)) else { return };
    if viewer.photo_strength <= 0.0 {
        return;
    }
    let scale = ui.ctx().pixels_per_point();
    let (camera, own) = (viewer.camera(size), &at.camera);
    let zoom = camera.fx / own.fx;
    let place = |x: f64, y: f64| {
        let x = camera.cx + (x - own.cx) * zoom;
        let y = camera.cy + (y - own.cy) * zoom;
        Pos2::new(x as f32 / scale, y as f32 / scale)
    };
    let rect =
        Rect::from_two_pos(place(0.0, 0.0), place(f64::from(own.width), f64::from(own.height)));
    let tint = Color32::WHITE.gamma_multiply(viewer.photo_strength);
    let whole = Rect::from_min_max(Pos2::ZERO, Pos2::new(1.0, 1.0));
    ui.painter().image(texture.id(), rect, whole, tint);
}

/// Moves the divider during a drag; returns whether it is dragged. The press position decides: egui's
/// position, at the end of the frame, may be past the divider.
pub fn hold_divider(viewer: &mut Viewer, ui: &Ui) -> bool {
    if !viewer.compares() {
        viewer.holds_divider = false;
        return false;
    }
    let screen = ui.ctx().content_rect();
    let x = screen.left() + viewer.divider * screen.width();
    let is_at = |at: Pos2| (at.x - x).abs() <= GRIP && ui.max_rect().contains(at);
    let (pressed, down, origin, at) = ui.input(|i| {
        let pointer = &i.pointer;
        let [pressed, down] = [pointer.primary_pressed(), pointer.primary_down()];
        (pressed, down, pointer.press_origin(), pointer.latest_pos())
    });
    viewer.holds_divider |= pressed && origin.is_some_and(is_at);
    let holds = viewer.holds_divider;
    if holds && let Some(at) = at {
        viewer.divider = ((at.x - screen.left()) / screen.width()).clamp(0.0, 1.0);
    }
    if holds || at.is_some_and(is_at) {
        ui.ctx().set_cursor_icon(egui::CursorIcon::ResizeHorizontal);
    }
    // The frame of the release has the last movement.
    viewer.holds_divider &= down;
    holds
}

/// Paints the divider between two models, and their names.
pub fn divider(viewer: &Viewer, ui: &Ui) {
    let [Some(left), Some(right)] = &viewer.shown else { return };
    let names = [viewer.name_of(&left.path), viewer.name_of(&right.path)];
    let screen = ui.ctx().content_rect();
    let x = screen.left() + viewer.divider * screen.width();
    let line = Stroke::new(2.0, Color32::WHITE);
    ui.painter().line_segment([Pos2::new(x, screen.top()), Pos2::new(x, screen.bottom())], line);
    let sides = [(Align2::RIGHT_TOP, -8.0), (Align2::LEFT_TOP, 8.0)];
    for ((align, offset), name) in sides.into_iter().zip(names) {
        let at = Pos2::new(x + offset, screen.top() + 8.0);
        let font = FontId::proportional(14.0);
        // Twice, so that it is legible on any picture.
        let shadow = at + egui::vec2(1.0, 1.0);
        ui.painter().text(shadow, align, &name, font.clone(), Color32::BLACK);
        ui.painter().text(at, align, &name, font, Color32::WHITE);
    }
}
