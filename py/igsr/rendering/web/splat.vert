// One corner of a splat's quad: the renderer's "project" for 8-bit parameters.

uniform usampler2D splats;
uniform usampler2D harmonics;
uniform mat3 rotation;    // file's frame to camera axes
uniform vec3 translation;
uniform vec4 lens;        // fx, fy, cx, cy in pixels
uniform vec2 size;        // of the picture, pixels
uniform vec4 limits;      // bounds of x/z, then of y/z, for the Jacobian
uniform bool antialiased;
uniform bool showsDepth;
uniform float depthUnit;  // depths are divided by this, since half floats end at 65504

in uint index;
out vec2 whitened;        // offset from the center, standard deviations
flat out vec4 paint;      // color or depth; opacity

const float TINY = 0.25 / 255.0;

uvec4 texel(usampler2D from, uint i) {
    return texelFetch(from, ivec2(int(i % TEXTURE_WIDTH), int(i / TEXTURE_WIDTH)), 0);
}

vec4 bytes(uint word) {
    return vec4(word & 255u, (word >> 8) & 255u, (word >> 16) & 255u, word >> 24);
}

// x, y, z, w: three components in 10 bits each, sign and magnitude, without the largest.
vec4 quaternion(uint word) {
    uint largest = word >> 30;
    vec4 q = vec4(0.0);
    float sum = 0.0;
    uint bits = word;
    for (int i = 3; i >= 0; i--) {
        if (uint(i) == largest) continue;
        float magnitude = float(bits & 511u) / 511.0 * sqrt(0.5);
        q[i] = (bits & 512u) == 0u ? magnitude : -magnitude;
        sum += magnitude * magnitude;
        bits >>= 10;
    }
    q[int(largest)] = sqrt(max(0.0, 1.0 - sum));
    return q;
}

mat3 axesOf(vec4 q) {
    vec3 d = q.xyz * q.xyz;
    float xy = q.x * q.y, xz = q.x * q.z, yz = q.y * q.z;
    float wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
    return mat3(
        1.0 - 2.0 * (d.y + d.z), 2.0 * (xy + wz), 2.0 * (xz - wy),
        2.0 * (xy - wz), 1.0 - 2.0 * (d.x + d.z), 2.0 * (yz + wx),
        2.0 * (xz + wy), 2.0 * (yz - wx), 1.0 - 2.0 * (d.x + d.y));
}

void main() {
    gl_Position = vec4(2.0, 2.0, 0.0, 1.0); // culled, unless set below
    uvec4 first = texel(splats, 2u * index);
    uvec4 second = texel(splats, 2u * index + 1u);
    vec3 mean = uintBitsToFloat(first.xyz);
    vec3 t = rotation * mean + translation;
    if (t.z < NEAR) return;

    // 2D covariance: m m^T + blur.
    vec3 scales = exp(bytes(second.x).xyz / 16.0 - 10.0);
    mat3 axes = axesOf(quaternion(second.y));
    vec2 slope = clamp(t.xy / t.z, limits.xz, limits.yw);
    mat3 rows = transpose(rotation);
    vec3 m0 = (transpose(axes) * ((rows[0] - rows[2] * slope.x) * (lens.x / t.z))) * scales;
    vec3 m1 = (transpose(axes) * ((rows[1] - rows[2] * slope.y) * (lens.y / t.z))) * scales;
    float sxx = dot(m0, m0), sxy = dot(m0, m1), syy = dot(m1, m1);
    // Sums of positive terms, without cancellation for needles.
    vec3 area = cross(m0, m1);
    float sharp = dot(area, area);
    float det = sharp + BLUR * (sxx + syy) + BLUR * BLUR;

    vec4 colors = bytes(first.w);
    float opacity = clamp(colors.w / 255.0, TINY, 1.0 - TINY);
    if (antialiased) opacity *= sqrt(sharp / det);
    if (opacity <= ALPHA_MIN) return;

    // The factor (p, q; 0, r) converts pixels to standard deviations; its inverse places corners.
    float cyy = syy + BLUR;
    float p = sqrt(cyy / det), q = -sxy / cyy * p, r = inversesqrt(cyy);
    float reach = sqrt(2.0 * log(opacity / ALPHA_MIN));
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    whitened = corner * reach;
    float dy = whitened.y / r;
    float dx = (whitened.x - q * dy) / p;
    vec2 center = lens.xy * t.xy / t.z + lens.zw;
    vec2 radii = reach * sqrt(vec2(sxx, syy) + BLUR);
    if (any(lessThan(center + radii, vec2(0.0))) || any(greaterThan(center - radii, size))) return;
    vec2 pixel = center + vec2(dx, dy);
    gl_Position = vec4(pixel.x / size.x * 2.0 - 1.0, 1.0 - pixel.y / size.y * 2.0, 0.0, 1.0);

    if (showsDepth) {
        paint = vec4(vec3(t.z / depthUnit), opacity);
        return;
    }
    vec3 color = (colors.xyz / 255.0 - 0.5) / 0.15 * SH_C0 + 0.5;
#if DEGREE > 0
    float basis[COEFFICIENTS];
    harmonicBasis(normalize(transpose(rotation) * t), basis);
    const uint words = uint(HARMONIC_TEXELS);
    for (uint k = 0u; k < words; k++) {
        uvec4 four = texel(harmonics, words * second.z + k);
        for (uint c = 0u; c < 4u; c++) {
            uint at = 4u * k + c;
            if (at < uint(COEFFICIENTS)) {
                color += basis[at] * (bytes(four[c]).xyz - 128.0) / 128.0;
            }
        }
    }
#endif
    paint = vec4(max(color, 0.0), opacity);
}
