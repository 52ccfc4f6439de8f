export const VERTEX=`
attribute vec3 rest;
attribute float part;
attribute float sky;
attribute float scalp;
varying vec3 vRest;
varying vec3 vNormal;
varying vec3 vView;
varying float vPart;
varying float vSky;
varying float vScalp;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  vRest = rest;
  vPart = part;
  vSky = sky;
  vScalp = scalp;
  vNormal = normalMatrix * normal;
  vView = -seen.xyz;
  gl_Position = projectionMatrix * seen;
}`,FRAGMENT=`
varying vec3 vRest;
varying vec3 vNormal;
varying vec3 vView;
varying float vPart;
varying float vSky;
varying float vScalp;

const vec3 KEY = vec3(-0.46, 0.52, 0.72);     // in the camera's axes: the light over the viewer's left shoulder
const vec3 FILL = vec3(0.86, 0.05, 0.50);
const vec3 RIM = vec3(0.62, 0.45, -0.64);

float hash(vec2 p) { return fract(sin(dot(p, vec2(127.1, 311.7))) * 43758.5453); }
float noise(vec2 p) {
  vec2 i = floor(p), f = fract(p);
  f = f * f * (3.0 - 2.0 * f);
  return mix(mix(hash(i), hash(i + vec2(1, 0)), f.x), mix(hash(i + vec2(0, 1)), hash(i + vec2(1, 1)), f.x), f.y);
}
float spot(vec3 at, vec3 size) {
  vec3 d = (vec3(vRest.x, abs(vRest.y), vRest.z) - at) / size;
  return exp(-dot(d, d));
}

vec3 skinColor(out float gloss) {
  float side = abs(vRest.y);
  vec3 color = vec3(0.575, 0.318, 0.218);
  float blotch = noise(vRest.yz * 160.0) * 0.6 + noise(vRest.xz * 420.0) * 0.4 - 0.5;
  color *= 1.0 + vec3(0.03, 0.055, 0.06) * blotch;
  float warm = 0.55 * spot(vec3(0.10, 0.040, 0.002), vec3(0.03, 0.019, 0.016))    // cheeks
             + 0.60 * spot(vec3(0.130, 0.0, 0.004), vec3(0.014, 0.016, 0.012))    // nose
             + 0.35 * spot(vec3(0.115, 0.0, -0.066), vec3(0.03, 0.018, 0.012))    // chin
             + 0.80 * smoothstep(0.070, 0.086, side) * step(vRest.z, 0.06);      // ears
  color = mix(color, vec3(0.56, 0.215, 0.145), 0.60 * min(warm, 1.0));
  float socket = spot(vec3(0.107, 0.030, 0.030), vec3(0.02, 0.020, 0.013));
  color = mix(color, vec3(0.36, 0.165, 0.115), 0.42 * socket);
  gloss = 0.30 + 0.25 * spot(vec3(0.128, 0.0, 0.012), vec3(0.02, 0.014, 0.03))
        + 0.12 * spot(vec3(0.11, 0.0, 0.075), vec3(0.03, 0.03, 0.02));

  // Lips, as in face/human.py: from the line where they meet, so far up and down as their outline allows.
  float across = side / 0.0255, above = vRest.z + 0.0345;
  float bow = 1.0 - 0.16 * exp(-pow(side / 0.0035, 2.0));
  float reach = above > 0.0 ? 0.0090 * bow * (1.0 - pow(across, 1.5)) : 0.0125 * (1.0 - across * across);
  float lip = smoothstep(-0.0012, 0.0014, reach - abs(above)) * step(across, 1.0) * step(0.090, vRest.x);
  color = mix(color, vec3(0.42, 0.135, 0.115) * (0.94 + 0.12 * noise(vec2(side * 1900.0, vRest.z * 120.0))), 0.85 * lip);
  gloss = mix(gloss, 0.62, lip);

  // Brows: hairs that lean outward, thick beside the nose, thin at the tail.
  float t = clamp((side - 0.0115) / 0.040, 0.0, 1.0);
  float middle = 0.0485 + 0.0075 * sin(3.14159 * (0.12 + 0.70 * t)) - 0.0045 * t * t;
  float thick = 0.0037 * min(1.0, 0.55 + 3.0 * t) * (1.0 - 0.72 * pow(t, 1.6));
  float off = (vRest.z - middle) / thick;
  float hairs = noise(vec2(side * 2300.0 - off * 2.6, off * 0.8 + 7.0));
  float ends = smoothstep(-0.05, 0.10, (side - 0.0115) / 0.04) * (1.0 - smoothstep(0.95, 1.05, (side - 0.0115) / 0.040));
  float brow = (1.0 - smoothstep(0.45, 1.25, abs(off) + 0.35 * (hairs - 0.5))) * ends * step(0.07, vRest.x);
  color = mix(color, vec3(0.055, 0.032, 0.020), brow * (0.55 + 0.38 * hairs));
  gloss *= 1.0 - 0.6 * brow;

  // Short hairs below the hairline, so that hair does not look put on.
  float stubble = smoothstep(0.15, 1.0, vScalp + 0.5 * (noise(vec2(vRest.y * 1500.0, vRest.z * 260.0 + vRest.x * 260.0)) - 0.5));
  color = mix(color, vec3(0.060, 0.033, 0.019), 0.92 * stubble);
  gloss *= 1.0 - stubble;

  return color;
}

vec3 eyeColor(out float pupilShade) {
  vec3 d = normalize(vRest - vec3(0.0895350, sign(vRest.y) * 0.0307767, 0.0334139));
  float angle = acos(clamp(d.x, -1.0, 1.0));
  float around = atan(d.z, d.y);
  float fibres = noise(vec2(around * 14.0, angle * 12.0)) * 0.6 + noise(vec2(around * 34.0, 2.0)) * 0.4;
  vec3 iris = mix(vec3(0.22, 0.105, 0.035), vec3(0.10, 0.105, 0.060), smoothstep(0.20, 0.42, angle)) * (0.55 + 0.95 * fibres);
  iris *= 1.0 - 0.75 * smoothstep(0.39, 0.465, angle);
  iris *= 0.75 + 0.5 * smoothstep(0.3, -0.4, d.z / 0.4);      // light falls through and gathers below
  vec3 white = vec3(0.66, 0.62, 0.585);
  white = mix(white, vec3(0.55, 0.25, 0.20), 0.50 * smoothstep(0.55, 1.05, angle));
  vec3 color = mix(iris, white, smoothstep(0.435, 0.485, angle));
  color = mix(vec3(0.012), color, smoothstep(0.172, 0.200, angle));
  pupilShade = angle;
  return color;
}

vec3 toScreen(vec3 c) {
  c = max(c, 0.0);
  c = c * (1.0 + 0.18 * c) / (1.0 + 0.42 * c) * 1.12;            // soft shoulder: highlights do not clip
  return pow(c, vec3(1.0 / 2.2));
}

void main() {
  vec3 n = normalize(vNormal), v = normalize(vView);
  if (!gl_FrontFacing) n = -n;
  int part = int(vPart + 0.5);
  vec3 key = normalize(KEY), fill = normalize(FILL), rim = normalize(RIM);
  float open = vSky;
  float gloss = 0.2, wrap = 0.0, angle = 0.0;
  vec3 color;
  if (part == 0) {
    color = skinColor(gloss); wrap = 1.0;
    float chin = smoothstep(-0.028, -0.062, vRest.z + 0.5 * vRest.x) * smoothstep(-0.045, -0.005, vRest.x);
    open *= 1.0 - 0.66 * chin;                                  // the shadow of the jaw, which rays of the sky miss
  }
  else if (part == 1) { color = eyeColor(angle); open = mix(0.42, 1.0, smoothstep(0.1, 0.9, open)); }
  else if (part == 2) {
    vec3 axis = normalize(vec3(-0.42, 0.0, 0.91)), d = normalize(vRest - vec3(0.012, 0.0, 0.052));
    vec3 front = vec3(axis.z, 0.0, -axis.x);
    float down = acos(clamp(dot(d, axis), -1.0, 1.0));
    float around = atan(d.y, dot(d, front)) + 0.55 * sin(down * 1.3);
    float strands = noise(vec2(around * 62.0, down * 2.6)) * 0.55 + noise(vec2(around * 190.0, down * 5.0 + 3.0)) * 0.45;
    if (vSky < 0.315 + 0.10 * noise(vec2(around * 260.0, down * 9.0)) + 0.08 * noise(vec2(around * 70.0, 1.0)) - 0.4 * smoothstep(0.066, 0.072, abs(vRest.y))) discard;   // the hairline ends in strands
    color = mix(vec3(0.018, 0.010, 0.006), vec3(0.115, 0.062, 0.033), strands * strands * 1.15);
    vec3 along = normalize(normalMatrix3(axis) - n * dot(normalMatrix3(axis), n));
    vec3 h = normalize(key + v);
    float th = dot(along, h) + 0.18 * (strands - 0.5);
    gloss = 0.0;
    color += vec3(0.20, 0.135, 0.09) * pow(max(1.0 - th * th, 0.0), 36.0) * (0.25 + strands) * smoothstep(-0.1, 0.5, dot(n, key));
    n = normalize(n + (strands - 0.5) * 0.35 * cross(along, n));
  }
  else if (part == 3) {
    float knit = 0.5 + 0.5 * sin(atan(vRest.y, vRest.x + 0.006) * (vRest.z > -0.1035 ? 150.0 : 0.0));
    color = vec3(0.026, 0.058, 0.090) * (0.86 + 0.28 * knit);
    gloss = 0.03; wrap = 0.35;
  }
  else if (part == 4) { color = vec3(0.60, 0.56, 0.48); gloss = 0.5; open = 0.25 + 0.75 * open; }
  else if (part == 5) { color = vec3(0.34, 0.085, 0.075); gloss = 0.5; open = 0.15 + 0.85 * open; }
  else {                                                        // lashes: strands that part towards their tips
    float out_m = distance(vRest, vec3(0.0895350, sign(vRest.y) * 0.0307767, 0.0334139)) - 0.0158;
    if (noise(vec2(vRest.y * 2400.0 + out_m * 500.0, 3.0)) < smoothstep(0.0014, 0.0080, out_m)) discard;
    color = vec3(0.022, 0.014, 0.010); gloss = 0.0; open = 1.0;
  }

  float k = dot(n, key), f = dot(n, fill), r = dot(n, rim);
  vec3 soft = wrap * vec3(0.34, 0.16, 0.11);                    // red light travels further under skin
  vec3 lit = vec3(1.62, 1.46, 1.30) * max((k + soft) / (1.0 + soft), 0.0) * mix(0.12, 1.0, open)
           + vec3(0.34, 0.40, 0.50) * max((f + soft) / (1.0 + soft), 0.0) * open
           + vec3(0.62, 0.66, 0.72) * max(r, 0.0) * open
           + mix(vec3(0.16, 0.13, 0.12), vec3(0.30, 0.33, 0.38), 0.5 + 0.5 * n.y) * mix(pow(open, 1.3), open, 0.4);
  vec3 occluded = mix(vec3(1.0), vec3(1.0, 0.80, 0.74), wrap * (1.0 - open) * 0.6);
  vec3 outgoing = color * lit * occluded;

  float fresnel = 0.04 + 0.96 * pow(1.0 - max(dot(n, v), 0.0), 5.0);
  vec3 h = normalize(key + v), h2 = normalize(fill + v);
  float nh = max(dot(n, h), 0.0), nh2 = max(dot(n, h2), 0.0);
  outgoing += gloss * open * (vec3(0.34, 0.32, 0.30) * pow(nh, 22.0) + vec3(0.26) * pow(nh, 70.0) + vec3(0.07, 0.08, 0.10) * pow(nh2, 18.0));
  outgoing += wrap * fresnel * 0.35 * vec3(0.75, 0.82, 0.95) * open * smoothstep(-0.2, 0.6, r);
  if (part == 1) {                                              // the window, and the room below it
    vec3 bent = normalize(n + 0.28 * (1.0 - smoothstep(0.0, 0.5, angle)) * vec3(0.0));
    vec3 mirror = reflect(-v, bent);
    float window = smoothstep(0.975, 0.990, dot(mirror, key)) + 0.35 * smoothstep(0.965, 0.985, dot(mirror, normalize(vec3(0.42, -0.30, 0.85))));
    outgoing += window * vec3(2.6) * open + fresnel * vec3(0.10);
  }
  gl_FragColor = vec4(toScreen(outgoing), 1.0);
}`.replaceAll("normalMatrix3(axis)","(viewMatrix * vec4(axis.y, axis.z, axis.x, 0.0)).xyz");
