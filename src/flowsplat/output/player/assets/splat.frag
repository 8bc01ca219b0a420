precision highp float;
in vec2 offset;
flat in vec4 color;
flat in vec2 slope;
out vec4 result;

void main() {
  float alpha = color.a * exp(-0.5 * dot(offset, offset));
  if (alpha < ALPHA_MIN) discard;
  alpha = min(alpha, ALPHA_MAX);
  result = vec4((color.rgb + dot(slope, offset)) * alpha, alpha);
}
