// The slice of every active Gaussian, one a pixel of three textures. (slice.glsl stands in front of this.)
uniform int count;
layout(location = 0) out vec4 axes;
layout(location = 1) out vec4 place;
layout(location = 2) out vec4 color;

void main() {
  int rank = int(gl_FragCoord.y) * SLICE_WIDTH + int(gl_FragCoord.x);
  if (rank >= count) discard;
  slice(rank, axes, place, color);
}
