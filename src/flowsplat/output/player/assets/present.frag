// The picture on the page; what no Gaussian covers takes its colour from the neighbours.
precision highp float;
precision highp sampler2D;
uniform sampler2D source;  // premultiplied
uniform sampler2D filled;
uniform bool isFilled;
out vec4 result;

void main() {
  vec4 own = texelFetch(source, ivec2(gl_FragCoord.xy), 0);
  float open = 1.0 - own.a;
  float ramp = isFilled ? clamp((open - 0.3) / 0.4, 0.0, 1.0) * open : 0.0;
  result = vec4(own.rgb + ramp * texelFetch(filled, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}
