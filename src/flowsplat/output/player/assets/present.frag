// The image on the page; what no Gaussian covers takes its color from the neighbors.
// Defined in front of this: FILLED_FROM and FILLED_TO (transmittances).
precision highp float;
precision highp sampler2D;
uniform sampler2D source;  // premultiplied
uniform sampler2D filled;
uniform bool isFilled;
uniform int left;  // where on the canvas the image begins
out vec4 result;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - ivec2(left, 0);
  vec4 own = texelFetch(source, at, 0);
  float open = 1.0 - own.a;
  float ramp = isFilled ? clamp((open - FILLED_FROM) / (FILLED_TO - FILLED_FROM), 0.0, 1.0) * open : 0.0;
  result = vec4(own.rgb + ramp * texelFetch(filled, at, 0).rgb, 1.0);
}
