// Spherical harmonics to colors, degree by degree. Follows geometry.wgsl and a file that declares
// sh_coefficient.

// Adds degree one, whose first coefficient is at `row`.
fn add_degree_one(before: vec3<f32>, direction: vec3<f32>, row: u32) -> vec3<f32> {
    let terms = sh_degree_one(direction);
    var color = before + terms[0].value * sh_coefficient(row);
    color += terms[1].value * sh_coefficient(row + 1u);
    color += terms[2].value * sh_coefficient(row + 2u);
    return color;
}

// Adds degree two, whose first coefficient is at `row`.
fn add_degree_two(before: vec3<f32>, direction: vec3<f32>, row: u32) -> vec3<f32> {
    let terms = sh_degree_two(direction);
    var color = before + terms[0].value * sh_coefficient(row);
    color += terms[1].value * sh_coefficient(row + 1u);
    color += terms[2].value * sh_coefficient(row + 2u);
    color += terms[3].value * sh_coefficient(row + 3u);
    color += terms[4].value * sh_coefficient(row + 4u);
    return color;
}

// Adds degree three, whose first coefficient is at `row`.
fn add_degree_three(before: vec3<f32>, direction: vec3<f32>, row: u32) -> vec3<f32> {
    let terms = sh_degree_three(direction);
    var color = before + terms[0].value * sh_coefficient(row);
    color += terms[1].value * sh_coefficient(row + 1u);
    color += terms[2].value * sh_coefficient(row + 2u);
    color += terms[3].value * sh_coefficient(row + 3u);
    color += terms[4].value * sh_coefficient(row + 4u);
    color += terms[5].value * sh_coefficient(row + 5u);
    color += terms[6].value * sh_coefficient(row + 6u);
    return color;
}

// Adds degree four, whose first coefficient is at `row`.
fn add_degree_four(before: vec3<f32>, direction: vec3<f32>, row: u32) -> vec3<f32> {
    let terms = sh_degree_four(direction);
    var color = before + terms[0].value * sh_coefficient(row);
    color += terms[1].value * sh_coefficient(row + 1u);
    color += terms[2].value * sh_coefficient(row + 2u);
    color += terms[3].value * sh_coefficient(row + 3u);
    color += terms[4].value * sh_coefficient(row + 4u);
    color += terms[5].value * sh_coefficient(row + 5u);
    color += terms[6].value * sh_coefficient(row + 6u);
    color += terms[7].value * sh_coefficient(row + 7u);
    color += terms[8].value * sh_coefficient(row + 8u);
    return color;
}
