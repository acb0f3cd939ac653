// One premultiplied pixel of a splat.

in vec2 whitened;
flat in vec4 paint;
out vec4 color;

void main() {
    float alpha = min(ALPHA_MAX, paint.a * exp(-0.5 * dot(whitened, whitened)));
    if (alpha < ALPHA_MIN) discard;
    color = vec4(paint.rgb * alpha, alpha);
}
