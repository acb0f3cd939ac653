// Colors that wait: a step keeps a splat's color gradient, and all waiting steps are done in one go when
// the splat is next projected. As cpu/waiting_colors.rs. Follows geometry.wgsl and adam_step.wgsl;
// color_rows.wgsl or color_groups.wgsl follows.

// The steps that colors may wait for.
struct ColorSteps {
    // Number of steps, without the current one.
    count: u32,
    // Number of splats, from the first, whose colors move.
    moving: u32,
    // Rates of the first coefficient and the rest, bias corrections of both moments.
    steps: array<vec4<f32>, COLOR_WAIT>,
}

@group(0) @binding(6) var<storage, read_write> first: array<f32>;
@group(0) @binding(7) var<storage, read_write> second: array<f32>;
// NOTES words per splat.
@group(0) @binding(8) var<storage, read_write> notes: array<u32>;
@group(0) @binding(9) var<storage, read> status: Status;
@group(0) @binding(10) var<uniform> waiting: ColorSteps;

struct Waiting {
    // Whether there are steps to do; none once a chunk's pairs did not fit, since the step is then done
    // again.
    moves: bool,
    // The first of them.
    next: u32,
    // Whether it has a gradient: by the color, for a view direction.
    has_gradient: bool,
    v_color: vec3<f32>,
    direction: vec3<f32>,
}

fn note_float(at: u32) -> f32 {
    return bitcast<f32>(notes[at]);
}

fn waiting_of(i: u32) -> Waiting {
    let note = i * NOTES;
    let word = notes[note + NOTE_WAITS];
    var w: Waiting;
    w.next = word >> 1u;
    w.moves = window.first + i < waiting.moving && w.next < waiting.count && status.overflow == 0u;
    w.has_gradient = w.moves && (word & 1u) == 1u;
    if w.has_gradient {
        let color = note + NOTE_COLOR;
        let direction = note + NOTE_DIRECTION;
        w.v_color = vec3(note_float(color), note_float(color + 1u), note_float(color + 2u));
        w.direction = vec3(note_float(direction), note_float(direction + 1u), note_float(direction + 2u));
    }
    return w;
}
