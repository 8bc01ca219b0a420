// A projected Gaussian as a quad round its ellipse. Corners are numbered through, four to a Gaussian: instances of four corners
// would leave most of a graphics card idle. With DIRECT (slice.glsl stands in front of this then) each corner slices for itself.
precision highp float;
precision highp int;
precision highp sampler2D;
#ifndef DIRECT
uniform sampler2D slicedAxes, slicedPlaces, slicedColors;
uniform vec2 size;     // of the image in pixels
#endif
out vec2 offset;       // from the center, in standard deviations
flat out vec4 color;  // rgb and opacity
flat out vec2 slope;  // how much brighter it gets along its two axes, a standard deviation

void main() {
  int rank = gl_VertexID >> 2;
  vec4 axes, place;
#ifdef DIRECT
  slice(rank, axes, place, color);
#else
  ivec2 at = ivec2(rank % SLICE_WIDTH, rank / SLICE_WIDTH);
  axes = texelFetch(slicedAxes, at, 0);
  place = texelFetch(slicedPlaces, at, 0);
  color = texelFetch(slicedColors, at, 0);
#endif
  offset = place.z * (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0);
  slope = vec2(axes.w, place.w);
  vec2 across = axes.z * inversesqrt(max(dot(axes.xy, axes.xy), 1e-24)) * vec2(-axes.y, axes.x);
  vec2 pixel = place.xy + offset.x * axes.xy + offset.y * across;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
