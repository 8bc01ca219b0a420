// The average of an image over the area of each target pixel, to about half the size.
precision highp float;
precision highp sampler2D;
uniform sampler2D source;
uniform vec2 ratio;  // source pixels a target pixel: 1 to 3
out vec4 result;

void main() {
  vec2 from = floor(gl_FragCoord.xy) * ratio, to = from + ratio;
  ivec2 first = ivec2(floor(from + 1e-4));
  ivec2 last = textureSize(source, 0) - 1;
  vec4 sum = vec4(0.0);
  for (int y = 0; y < 4; y++) {
    for (int x = 0; x < 4; x++) {
      vec2 corner = vec2(first + ivec2(x, y));
      vec2 part = max(min(corner + 1.0, to) - max(corner, from), 0.0);
      sum += part.x * part.y * texelFetch(source, min(first + ivec2(x, y), last), 0);
    }
  }
  result = sum / (ratio.x * ratio.y);
}
