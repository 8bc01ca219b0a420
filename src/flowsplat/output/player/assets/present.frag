// The image on the page; what no Gaussian covers takes its color from the neighbors, or fades into the page where there are none.
// Defined in front of this: FILLED_FROM and FILLED_TO (transmittances).
precision highp float;
precision highp sampler2D;
uniform sampler2D source;  // premultiplied
uniform sampler2D filled;
uniform sampler2D around;  // small
uniform vec2 size;
uniform bool isFilled, isMasked;
uniform int left;  // where on the canvas the image begins
out vec4 result;

const vec3 PAGE = vec3(16.0, 18.0, 20.0) / 255.0;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - ivec2(left, 0);
  vec4 own = texelFetch(source, at, 0);
  float open = 1.0 - own.a;
  float ramp = isFilled ? clamp((open - FILLED_FROM) / (FILLED_TO - FILLED_FROM), 0.0, 1.0) * open : 0.0;
  vec3 shown = own.rgb + ramp * texelFetch(filled, at, 0).rgb;
  float kept = isMasked ? smoothstep(0.35, 0.65, texture(around, (vec2(at) + 0.5) / size).a) : 1.0;
  result = vec4(mix(PAGE, shown, kept), 1.0);
}
