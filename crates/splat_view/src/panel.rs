//! The side panel: settings, cameras, files, statistics.

use egui::{ComboBox, Panel, ScrollArea, Slider, SliderClamping, Ui};
use glam::DVec3;

use crate::display::{Display, Drawing};
use crate::sources::label;
use crate::stage_times::{SECOND, STAGES};
use crate::viewer::{Action, Moving, Viewer};

const AXES: [(DVec3, &str); 6] = [
    (DVec3::NEG_Y, "-y"),
    (DVec3::Y, "y"),
    (DVec3::Z, "z"),
    (DVec3::NEG_Z, "-z"),
    (DVec3::X, "x"),
    (DVec3::NEG_X, "-x"),
];
/// Most that notes take of the panel, in points.
const NOTES_HEIGHT: f32 = 200.0;
/// Keys and gestures, as the panel lists them.
const KEYS: &str = "\
drag: orbit; right drag or Shift: pan; wheel: zoom
double click: orbit about this point
W A S D Q E, arrows: move, turn; Shift: faster
1-5: display   V: orbit, fly, first person   F: fit scene
C: cameras   [ ]: previous, next camera   H: panel
P: screenshot   Shift P: EXR with depth
K: mark a place   R: record   Esc: stop";

/// Shows the panel; `times` are milliseconds of the stages.
pub fn panel(
    viewer: &mut Viewer,
    ui: &mut Ui,
    times: Option<[f32; STAGES.len()]>,
    actions: &mut Vec<Action>,
) {
    notes(viewer, ui);
    ScrollArea::vertical().show(ui, |ui| {
        models(viewer, ui, actions);
        ui.separator();
        display(viewer, ui);
        ui.separator();
        camera(viewer, ui, actions);
        if !viewer.cameras.is_empty() {
            ui.separator();
            capture(viewer, ui, actions);
        }
        ui.separator();
        files(viewer, ui, actions);
        ui.separator();
        statistics(viewer, ui, times);
        ui.collapsing("Keys", |ui| ui.small(KEYS));
    });
}

/// Notes at the panel's foot, so that lists do not push them out of sight.
fn notes(viewer: &Viewer, ui: &mut Ui) {
    if viewer.notes.texts().next().is_none() {
        return;
    }
    Panel::bottom("notes").show(ui, |ui| {
        let area =
            ScrollArea::vertical().max_height(NOTES_HEIGHT).min_scrolled_height(NOTES_HEIGHT);
        area.stick_to_bottom(true).show(ui, |ui| {
            for (i, note) in viewer.notes.texts().enumerate() {
                if i > 0 {
                    ui.separator();
                }
                ui.label(note);
            }
        });
    });
}

fn choice(viewer: &Viewer, ui: &mut Ui, side: usize, actions: &mut Vec<Action>) {
    let chosen = viewer.number_of(side);
    let text = viewer.chosen[side].as_deref().map_or("none".to_owned(), |p| viewer.name_of(p));
    ComboBox::from_id_salt(("model", side)).selected_text(text).show_ui(ui, |ui| {
        if side == 1 && ui.selectable_label(chosen.is_none(), "none").clicked() {
            actions.push(Action::Choose(side, None));
        }
        for (number, source) in viewer.sources.iter().enumerate() {
            let name = label(source, &viewer.sources);
            if ui.selectable_label(chosen == Some(number), name).clicked() {
                actions.push(Action::Choose(side, Some(number)));
            }
        }
    });
}

fn models(viewer: &Viewer, ui: &mut Ui, actions: &mut Vec<Action>) {
    if viewer.sources.is_empty() {
        ui.label("Drop a splat file or the folder of a fit here.");
        return;
    }
    ui.horizontal(|ui| {
        ui.label("Model");
        choice(viewer, ui, 0, actions);
    });
    if viewer.sources.len() > 1 {
        ui.horizontal(|ui| {
            ui.label("Compare with");
            choice(viewer, ui, 1, actions);
        });
    }
}

fn display(viewer: &mut Viewer, ui: &mut Ui) {
    ui.horizontal_wrapped(|ui| {
        for (display, name) in Display::ALL {
            ui.selectable_value(&mut viewer.settings.display, display, name);
        }
    });
    if viewer.settings.display == Display::Splats {
        ui.horizontal(|ui| {
            ui.label("Draw");
            for (drawing, name) in Drawing::ALL {
                ui.selectable_value(&mut viewer.settings.drawing, drawing, name);
            }
        });
    }
    if viewer.settings.display == Display::Points {
        ui.add(Slider::new(&mut viewer.settings.radius, 0.5..=8.0).text("point size, px"));
    }
    let stored = viewer.shown.iter().flatten().map(|s| s.model.file.splats.sh_degree).max();
    if let Some(stored) = stored.filter(|&degree| degree > 0) {
        // The setting stays as it is for models of a higher degree.
        let mut degree = viewer.settings.sh_degree.min(stored);
        if ui.add(Slider::new(&mut degree, 0..=stored).text("SH degree")).changed() {
            viewer.settings.sh_degree = degree;
        }
    }
    ui.horizontal(|ui| {
        ui.color_edit_button_rgb(&mut viewer.settings.background);
        ui.label("Background");
    });
}

fn camera(viewer: &mut Viewer, ui: &mut Ui, actions: &mut Vec<Action>) {
    ui.horizontal_wrapped(|ui| {
        for (moving, name) in Moving::ALL {
            ui.selectable_value(&mut viewer.moving, moving, name);
        }
    });
    let mut degrees = viewer.settings.fov.to_degrees();
    if ui.add(Slider::new(&mut degrees, 5.0..=150.0).text("field of view")).changed() {
        viewer.at_camera = None;
        viewer.settings.fov = degrees.to_radians();
    }
    let far = (4.0 * viewer.extent().1) as f32;
    let range = 1e-4 * far..=far;
    // A near plane given by --near may lie outside the range, and stays until it is moved.
    let near = Slider::new(&mut viewer.settings.near, range).logarithmic(true);
    ui.add(near.clamping(SliderClamping::Edits).text("near plane"));
    ui.horizontal(|ui| {
        let found = AXES.iter().find(|(axis, _)| axis.dot(viewer.up) > 0.999);
        let other = if viewer.cameras.is_empty() { "estimated" } else { "cameras" };
        let text = found.map_or(other, |(_, name)| name);
        ComboBox::from_label("up axis").width(60.0).selected_text(text).show_ui(ui, |ui| {
            for (axis, name) in AXES {
                if ui.selectable_label(viewer.up == axis, name).clicked() {
                    viewer.up = axis;
                    actions.push(Action::Frame);
                }
            }
        });
        if ui.button("Fit scene (F)").clicked() {
            actions.push(Action::Frame);
        }
    });
}

fn capture(viewer: &mut Viewer, ui: &mut Ui, actions: &mut Vec<Action>) {
    ui.checkbox(&mut viewer.shows_cameras, format!("{} cameras", viewer.cameras.len()));
    let at = viewer.at_camera;
    ScrollArea::vertical().id_salt("cameras").max_height(110.0).show(ui, |ui| {
        for (number, camera) in viewer.cameras.iter().enumerate() {
            let name = format!("{number}  {}", camera.name);
            if ui.selectable_label(at == Some(number), name).clicked() {
                actions.push(Action::Jump(number));
            }
        }
    });
    if at.and_then(|i| viewer.cameras[i].photo.as_ref()).is_some() {
        ui.add(Slider::new(&mut viewer.photo_strength, 0.0..=1.0).text("photo opacity"));
    }
}

fn files(viewer: &mut Viewer, ui: &mut Ui, actions: &mut Vec<Action>) {
    ui.horizontal(|ui| {
        if ui.button("Screenshot (P)").clicked() {
            actions.push(Action::Screenshot);
        }
        if ui.button("EXR").on_hover_text("with alpha and depth").clicked() {
            actions.push(Action::SaveExr);
        }
    });
    ui.horizontal(|ui| {
        if ui.button(format!("Mark place {} (K)", viewer.path.keys.len() + 1)).clicked() {
            viewer.path.keys.push(viewer.viewpoint);
        }
        if !viewer.path.keys.is_empty() && ui.button("Clear places").clicked() {
            viewer.path.keys.clear();
        }
    });
    if let Some(recording) = &viewer.recording {
        ui.label(format!("Picture {} of {} (Esc stops)", recording.next, recording.total()));
    } else if viewer.path.keys.len() > 1 {
        let between = &mut viewer.pictures_between;
        ui.add(Slider::new(between, 1..=600).logarithmic(true).text("pictures per segment"));
        let total = viewer.path.pictures(viewer.pictures_between);
        if ui.button(format!("Record {total} pictures (R)")).clicked() {
            actions.push(Action::Record);
        }
    }
}

fn statistics(viewer: &Viewer, ui: &mut Ui, times: Option<[f32; STAGES.len()]>) {
    for shown in viewer.shown.iter().flatten() {
        let splats = shown.model.file.splats.len();
        let of = shown.model.whole.map_or_else(String::new, |whole| format!(" of {whole}"));
        ui.label(format!("{splats}{of} splats: {}", viewer.name_of(&shown.path)));
    }
    ui.label(format!("Frame: {:.1} ms", viewer.frame_ms));
    let Some(times) = times else {
        ui.label("This device has no timestamps.");
        return;
    };
    egui::Grid::new("times").show(ui, |ui| {
        for (stage, name) in STAGES.iter().enumerate() {
            if times[stage] > 0.0 {
                let side = if (SECOND..2 * SECOND).contains(&stage) { ", right" } else { "" };
                ui.label(format!("{name}{side}"));
                ui.label(format!("{:.2} ms", times[stage]));
                ui.end_row();
            }
        }
    });
    ui.small(&viewer.device);
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use egui::{CentralPanel, Context, RawInput};
    use splat_render::fit::SplatArrays;
    use splat_render::gpu::Gpu;
    use splat_render::io::SplatFile;

    use super::*;
    use crate::display::Settings;
    use crate::model::Model;
    use crate::painter::Painter;
    use crate::viewer::Shown;

    /// The settings after two frames without input on the panel.
    fn untouched(mut viewer: Viewer) -> Settings {
        let context = Context::default();
        for _ in 0..2 {
            let mut output = context.run_ui(RawInput::default(), |ui| {
                CentralPanel::default()
                    .show(ui, |ui| panel(&mut viewer, ui, None, &mut Vec::new()));
            });
            // Nothing is painted here: egui asks that its textures are then dropped by name.
            output.textures_delta.clear();
        }
        viewer.settings
    }

    #[test]
    fn a_near_plane_outside_its_slider_stays_until_it_is_moved() {
        for near in [1e-6, 7.0, 1e6] {
            let settings = Settings { near, ..Settings::default() };
            assert_eq!(untouched(Viewer::new(settings, String::new())), settings);
        }
    }

    #[test]
    fn a_lower_model_keeps_the_chosen_sh_degree() {
        let gpu = Arc::new(Gpu::new(true).expect("an adapter, a software one will do"));
        let painter = Painter::new(gpu, wgpu::TextureFormat::Rgba8Unorm).expect("a painter");
        let splats = SplatArrays {
            means: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            scales: vec![[0.0; 3]],
            opacities: vec![0.0],
            sh: vec![[0.0; 3]; 4],
            sh_degree: 1,
        };
        let file = SplatFile { splats, origin: [0.0; 3], antialiased: false };
        let drawable = painter.upload(&file).expect("a splat has room");
        let (center, notes) = (DVec3::ZERO, Vec::new());
        let model = Model { file, center, radius: 1.0, notes, detail: None, whole: None };
        let mut viewer = Viewer::new(Settings::default(), String::new());
        let path = "a.ply".into();
        viewer.shown[0] = Some(Shown { path, stamp: None, model, drawable, streaming: None });
        assert_eq!(untouched(viewer), Settings::default());
    }
}
