// The blended picture over the background, or depths in gray, near ones light.

uniform sampler2D picture;
uniform vec3 background;
uniform bool showsDepth;
uniform vec2 depthRange; // as multiples of depthUnit
out vec4 color;

void main() {
    vec4 blended = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
    vec3 shown = blended.rgb + (1.0 - blended.a) * background;
    if (showsDepth) {
        float depth = blended.r / max(blended.a, 1e-3);
        float part = clamp((depth - depthRange.x) / (depthRange.y - depthRange.x), 0.0, 1.0);
        shown = vec3((1.0 - 0.9 * part) * blended.a);
    }
    color = vec4(clamp(shown, 0.0, 1.0), 1.0);
}
