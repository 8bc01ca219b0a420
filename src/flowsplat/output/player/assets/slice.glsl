// The slice: one Gaussian at the time, projected (EWA), with its color as seen from the camera.
// Defined in front of this: OBJECT_TEXELS, WIDTH and SLICE_WIDTH (texels and rows of `order` in a line of a texture), SH_COUNT, STATE_SIZE, SLOPE_TEXELS, GAIN_TEXELS, MEAN_DEGREE, QUAT_DEGREE, EPS2D, FOCAL, ALPHA_MIN, P_MIN.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order;   // rows of the active Gaussians, farthest first
uniform sampler2D states;   // STATE_SIZE texels a Gaussian: mean and opacity, quaternion, scales and place of the object, color and reach, other harmonics, slopes
uniform sampler2D motions;  // 1 + MEAN_DEGREE + QUAT_DEGREE texels a moving one: middle, 1 / half length, center, precision; coefficients
uniform sampler2D gains;    // GAIN_TEXELS texels a resting one
uniform int resting;        // how many do not move: the first ones
uniform float time;
uniform vec4 cosines[GAIN_TEXELS + 1];
uniform mat3 rotation;      // world to camera
uniform vec3 translation;
uniform vec3 center;        // of the camera, in the world
uniform vec4 lens;          // fx, fy, cx, cy in pixels
uniform vec2 size;          // of the image in pixels
uniform float near;
uniform vec3 pivot;         // where the clip's camera is at the time
uniform bool isConfidenceFade;      // whether Gaussians fade beyond their reach
uniform vec4 factors[OBJECT_TEXELS];  // by the place of the object, how many times as far from there it is as it was trained

vec4 texel(sampler2D source, int at) {
  return texelFetch(source, ivec2(at % WIDTH, at / WIDTH), 0);
}

vec3 harmonics(int at, vec3 d) {
  vec3 sum = 0.28209479177387814 * texel(states, at).rgb;
#if SH_COUNT > 1
  sum += 0.4886025119029199 * (-d.y * texel(states, at + 1).rgb + d.z * texel(states, at + 2).rgb - d.x * texel(states, at + 3).rgb);
#endif
#if SH_COUNT > 4
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  sum += 1.0925484305920792 * (d.x * d.y * texel(states, at + 4).rgb - d.y * d.z * texel(states, at + 5).rgb
      - d.x * d.z * texel(states, at + 7).rgb);
  sum += 0.31539156525252005 * (2.0 * zz - xx - yy) * texel(states, at + 6).rgb;
  sum += 0.5462742152960396 * (xx - yy) * texel(states, at + 8).rgb;
#endif
#if SH_COUNT > 9
  sum += -0.5900435899266435 * (d.y * (3.0 * xx - yy) * texel(states, at + 9).rgb
      + d.x * (xx - 3.0 * yy) * texel(states, at + 15).rgb);
  sum += 2.890611442640554 * d.x * d.y * d.z * texel(states, at + 10).rgb;
  sum += -0.4570457994644658 * (4.0 * zz - xx - yy) * (d.y * texel(states, at + 11).rgb + d.x * texel(states, at + 13).rgb);
  sum += 0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * texel(states, at + 12).rgb;
  sum += 1.445305721320277 * d.z * (xx - yy) * texel(states, at + 14).rgb;
#endif
  return max(sum + 0.5, 0.0);
}

// The Gaussian in place `rank` of the order.
// axes: of its ellipse in pixels, one standard deviation long: the long one, length of the short one; how much brighter it gets along the long one
// place: its center in pixels, how many standard deviations are drawn (0: none), how much brighter it gets along the short axis
// color: rgb and opacity
void slice(int rank, out vec4 axes, out vec4 place, out vec4 color) {
  axes = vec4(0.0);
  place = vec4(0.0);
  color = vec4(0.0);
  int i = int(texelFetch(order, ivec2(rank % SLICE_WIDTH, rank / SLICE_WIDTH), 0).r);
  int at = i * STATE_SIZE;
  vec4 state = texel(states, at);
  vec4 q = texel(states, at + 1);
  vec4 shape = texel(states, at + 2);
  int obj = int(shape.w + 0.5);
  float factor = factors[obj >> 2][obj & 3];
  vec3 scales = factor * shape.xyz;
  vec3 mean = state.xyz;
  float opacity = state.w;
  float gain = 1.0;

  if (i >= resting) {
    int motion = (i - resting) * (1 + MEAN_DEGREE + QUAT_DEGREE);
    vec4 when = texel(motions, motion);
    float tau = time - when.z;
    float presence = exp(-0.5 * when.w * tau * tau);
    if (presence < P_MIN) return;
    opacity *= presence;
    float s = (time - when.x) * when.y;
    float before = 1.0, now = s;  // Chebyshev polynomials of degree k - 1 and k
    for (int k = 1; k <= max(MEAN_DEGREE, QUAT_DEGREE); k++) {
      if (k <= MEAN_DEGREE) mean += now * texel(motions, motion + k).xyz;
      if (k <= QUAT_DEGREE) q += now * texel(motions, motion + MEAN_DEGREE + k);
      float next = 2.0 * s * now - before;
      before = now;
      now = next;
    }
  }
#if GAIN_TEXELS > 0
  else {
    float exponent = 0.0;
    for (int k = 0; k < GAIN_TEXELS; k++) exponent += dot(texel(gains, i * GAIN_TEXELS + k), cosines[k]);
    gain = exp(exponent);
  }
#endif

  mean = pivot + factor * (mean - pivot);
  if (isConfidenceFade) {
    // As confidence_fade.py: by how much the direction to the viewer differs from that to the clip's camera.
    float off = distance(normalize(center - mean), normalize(pivot - mean));
    opacity *= clamp(2.0 - off / texel(states, at + 3).w, 0.0, 1.0);
  }
  vec3 p = rotation * mean + translation;
  if (p.z <= near || opacity <= ALPHA_MIN) return;
  float inverse = 1.0 / p.z;
  vec2 pixel = lens.xy * p.xy * inverse + lens.zw;
  // As gsplat: the derivative is taken no farther than 0.15 image sizes outside.
  vec2 tangent = clamp(p.xy * inverse, (-0.15 * size - lens.zw) / lens.xy, (1.15 * size - lens.zw) / lens.xy);

  q *= inversesqrt(max(dot(q, q), 1e-24));
  mat3 turn = mat3(
      1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
      2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
      2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 M = rotation * turn;
  // Rows of the projected standard deviations: J R S.
  vec3 across = lens.x * inverse * scales * (vec3(M[0].x, M[1].x, M[2].x) - tangent.x * vec3(M[0].z, M[1].z, M[2].z));
  vec3 down = lens.y * inverse * scales * (vec3(M[0].y, M[1].y, M[2].y) - tangent.y * vec3(M[0].z, M[1].z, M[2].z));
  // Where pixels are finer than those of training, the blur of training is as much wider (SceneModel.blur).
  float finer = FOCAL > 0.0 ? max(lens.x / FOCAL, 1.0) : 1.0;
  float blur = EPS2D * finer * finer;
  float a = dot(across, across) + blur, b = dot(across, down), c = dot(down, down) + blur;

  float middle = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
  float large = middle + spread;
  float small = max((a * c - b * b) / large, 1e-6);
  vec2 axis = a >= c ? vec2(large - c, b) : vec2(b, large - a);
  axis = spread > 1e-6 * middle ? normalize(axis) : vec2(1.0, 0.0);

  vec2 slope = vec2(0.0);  // how much brighter it gets a pixel to the right and down
#if SLOPE_TEXELS > 0
  vec2 along = texel(states, at + STATE_SIZE - 1).xy;
  vec2 turned = vec2(dot(across.xy, along), dot(down.xy, along));
  slope = vec2(c * turned.x - b * turned.y, a * turned.y - b * turned.x) / (large * small);
#endif
  axes = vec4(sqrt(large) * axis, sqrt(small), sqrt(large) * dot(slope, axis));
  place = vec4(pixel, sqrt(2.0 * log(opacity / ALPHA_MIN)), sqrt(small) * dot(slope, vec2(-axis.y, axis.x)));
  color = vec4(gain * harmonics(at + 3, normalize(mean - center)), opacity);
}
