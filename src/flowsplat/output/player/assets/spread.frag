// Colors of covered pixels, and in the others those of the smaller image.
precision highp float;
precision highp sampler2D;
uniform sampler2D source;   // premultiplied
uniform sampler2D smaller;  // filled; not used where isSmallest
uniform bool isSmallest;
in vec2 place;
out vec4 result;

void main() {
  vec4 own = texelFetch(source, ivec2(gl_FragCoord.xy), 0);
  if (isSmallest) result = vec4(own.rgb / max(own.a, 1e-6), 1.0);
  else result = vec4(own.rgb + (1.0 - clamp(own.a, 0.0, 1.0)) * texture(smaller, place).rgb, 1.0);
}
