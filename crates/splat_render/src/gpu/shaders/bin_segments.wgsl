// The depth order in SEGMENTS contiguous parts, one for each workgroup. Follows shared.wgsl and a binding
// of the status.

override SEGMENTS: u32 = 64u;

// Saturates: 1 M splats on 1 M tiles would not fit 32 bits.
fn add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

// First and one-past-last rank of part `part` of a segment in `parts` parts.
fn ranks(segment: u32, part: u32, parts: u32) -> vec2<u32> {
    let length = (status.visible + SEGMENTS - 1u) / SEGMENTS;
    let end = min((segment + 1u) * length, status.visible);
    let per_part = (length + parts - 1u) / parts;
    let begin = min(segment * length + part * per_part, end);
    return vec2(begin, min(begin + per_part, end));
}
