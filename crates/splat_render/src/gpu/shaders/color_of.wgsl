// The color of a splat by its thread alone. Follows geometry.wgsl and a declaration of catch_up;
// sh_color.wgsl follows.

fn sh_coefficient(at: u32) -> vec3<f32> {
    return coefficient(at);
}

// Before the cut at zero, of a splat that is drawn.
fn color_of(i: u32, local: u32, is_drawn: bool, direction: vec3<f32>) -> vec3<f32> {
    if !is_drawn {
        return vec3(0.0);
    }
    if mode.sh_stride == 0u {
        return coefficient(i);
    }
    catch_up(i);
    let row = i * mode.sh_stride;
    var color = SH_C0 * coefficient(row);
    if mode.sh_degree >= 1u {
        color = add_degree_one(color, direction, row + 1u);
    }
    if mode.sh_degree >= 2u {
        color = add_degree_two(color, direction, row + 4u);
    }
    if mode.sh_degree >= 3u {
        color = add_degree_three(color, direction, row + 9u);
    }
    if mode.sh_degree >= 4u {
        color = add_degree_four(color, direction, row + 16u);
    }
    return color + 0.5;
}
