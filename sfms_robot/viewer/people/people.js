var q={uint8:Uint8Array,uint16:Uint16Array,int16:Int16Array},d=[-.012,0,-.065];function U(t){let s=new DataView(t).getUint32(0,!0),o=JSON.parse(new TextDecoder().decode(new Uint8Array(t,4,s)));if(o.version!==1)throw new Error(`mesh of version ${o.version}; this page reads version 1`);let e={},n=4+s;for(let[c,l,h]of o.arrays)n+=(4-n%4)%4,e[c]=new q[l](t,n,h),n+=e[c].byteLength;let a=new Map,r=0;for(let{name:c,count:l,step_m:h}of o.morphs){let v=e.moved.subarray(r,r+l);a.set(c,{moved:v,moves:e.moves.subarray(3*r,3*(r+l)),step:h}),r+=l}let i=Float32Array.from(e.rest,c=>c*o.step_m);return{...e,facts:o,rest:i,morphs:a,openSky:e.open_sky}}var x=class{constructor(s){this.head=s,this.positions=Float32Array.from(s.rest),this.normals=new Float32Array(s.rest.length),this.#t()}pose(s){let{rest:o,morphs:e}=this.head,n=this.positions;n.set(o);let a=6;for(let{moved:r,moves:i,step:c}of e.values()){let l=s[a++]*c;if(!(Math.abs(l)<1e-12))for(let h=0,v=0;h<r.length;h++,v+=3){let p=3*r[h];n[p]+=l*i[v],n[p+1]+=l*i[v+1],n[p+2]+=l*i[v+2]}}this.#e(s),this.#t()}#e(s){let{share:o}=this.head,e=this.positions,n=new Array(256);for(let a=0;a<o.length;a++){let r=o[a];if(r===0)continue;let i=n[r]??=K(s,r/255),c=3*a,l=e[c]-d[0],h=e[c+1]-d[1],v=e[c+2]-d[2];e[c]=i[0]*l+i[1]*h+i[2]*v+i[9],e[c+1]=i[3]*l+i[4]*h+i[5]*v+i[10],e[c+2]=i[6]*l+i[7]*h+i[8]*v+i[11]}}#t(){let{triangles:s}=this.head,o=this.positions,e=this.normals;e.fill(0);for(let n=0;n<s.length;n+=3){let a=3*s[n],r=3*s[n+1],i=3*s[n+2],c=o[r]-o[a],l=o[r+1]-o[a+1],h=o[r+2]-o[a+2],v=o[i]-o[a],p=o[i+1]-o[a+1],y=o[i+2]-o[a+2],M=l*y-h*p,z=h*v-c*y,T=c*p-l*v;e[a]+=M,e[a+1]+=z,e[a+2]+=T,e[r]+=M,e[r+1]+=z,e[r+2]+=T,e[i]+=M,e[i+1]+=z,e[i+2]+=T}for(let n=0;n<e.length;n+=3){let a=Math.hypot(e[n],e[n+1],e[n+2])||1;e[n]/=a,e[n+1]/=a,e[n+2]/=a}}};function K(t,s){let[o,e,n]=[t[0]*s,t[1]*s,t[2]*s],a=Math.cos(o),r=Math.sin(o),i=Math.cos(e),c=Math.sin(e),l=Math.cos(n),h=Math.sin(n);return[l*i,l*c*r-h*a,l*c*a+h*r,h*i,h*c*r+l*a,h*c*a-l*r,-c,i*r,i*a,d[0]+t[3]*s,d[1]+t[4]*s,d[2]+t[5]*s]}var B=`
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
}`,P=`
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
}`.replaceAll("normalMatrix3(axis)","(viewMatrix * vec4(axis.y, axis.z, axis.x, 0.0)).xyz");var W=`uniform mat4 modelViewMatrix, projectionMatrix, viewMatrix;
uniform mat3 normalMatrix;
`,_=[0,-.012,.02],X=1.05,J=.37,Z=[0,0,1,0,1,0,0,0,0,1,0,0,0,0,0,1],b=class{constructor(s,o){this.canvas=s;let e=this.gl=s.getContext("webgl2",{antialias:!0});if(!e)throw new Error("this browser has no WebGL 2, which drawing the faces needs");this.head=U(o),this.posed=new x(this.head),this.program=tt(e,`precision highp float;
${W}attribute vec3 position;
attribute vec3 normal;
${B}`,`precision highp float;
uniform mat4 viewMatrix;
${P}`),e.useProgram(this.program),this.#t("rest",this.head.rest,3,e.FLOAT),this.#t("part",this.head.part,1,e.UNSIGNED_BYTE),this.#t("sky",this.head.openSky,1,e.UNSIGNED_BYTE,!0),this.#t("scalp",this.head.scalp,1,e.UNSIGNED_BYTE,!0),this.position=this.#t("position",this.posed.positions,3,e.FLOAT),this.normal=this.#t("normal",this.posed.normals,3,e.FLOAT),e.bindBuffer(e.ELEMENT_ARRAY_BUFFER,e.createBuffer()),e.bufferData(e.ELEMENT_ARRAY_BUFFER,this.head.triangles,e.STATIC_DRAW),e.enable(e.DEPTH_TEST)}show(s){let{gl:o,canvas:e,posed:n}=this,a=window.devicePixelRatio||1,[r,i]=[Math.round(e.clientWidth*a),Math.round(e.clientHeight*a)];(e.width!==r||e.height!==i)&&Object.assign(e,{width:r,height:i}),n.pose(s);for(let[p,y]of[[this.position,n.positions],[this.normal,n.normals]])o.bindBuffer(o.ARRAY_BUFFER,p),o.bufferData(o.ARRAY_BUFFER,y,o.DYNAMIC_DRAW);o.viewport(0,0,r,i),o.clearColor(.905,.915,.925,1),o.clear(o.COLOR_BUFFER_BIT|o.DEPTH_BUFFER_BIT);let c=[1,0,0,0,0,1,0,0,0,0,1,0,-_[0],-_[1],-_[2]-X,1],l=Z.slice();for(let p=0;p<3;p++)l[12+p]=c[12+p];let h=[0,1,2,4,5,6,8,9,10].map(p=>l[p]);o.uniformMatrix4fv(this.#e("viewMatrix"),!1,c),o.uniformMatrix4fv(this.#e("modelViewMatrix"),!1,l),o.uniformMatrix4fv(this.#e("projectionMatrix"),!1,Q(r/i)),o.uniformMatrix3fv(this.#e("normalMatrix"),!1,h);let v=this.head.triangles instanceof Uint32Array?o.UNSIGNED_INT:o.UNSIGNED_SHORT;o.drawElements(o.TRIANGLES,this.head.triangles.length,v,0)}#e(s){return this.gl.getUniformLocation(this.program,s)}#t(s,o,e,n,a=!1){let{gl:r}=this,i=r.createBuffer(),c=r.getAttribLocation(this.program,s);return r.bindBuffer(r.ARRAY_BUFFER,i),r.bufferData(r.ARRAY_BUFFER,o,r.STATIC_DRAW),c>=0&&(r.enableVertexAttribArray(c),r.vertexAttribPointer(c,e,n,a,0,0)),i}};function Q(t){let n=Math.min(1,t/.9)/Math.tan(J/2);return[n/t,0,0,0,0,n,0,0,0,0,(10+.1)/(.1-10),-1,0,0,20*.1/(.1-10),0]}function tt(t,s,o){let e=t.createProgram();for(let[n,a]of[[t.VERTEX_SHADER,s],[t.FRAGMENT_SHADER,o]]){let r=t.createShader(n);if(t.shaderSource(r,a),t.compileShader(r),!t.getShaderParameter(r,t.COMPILE_STATUS))throw new Error(t.getShaderInfoLog(r));t.attachShader(e,r)}if(t.linkProgram(e),!t.getProgramParameter(e,t.LINK_STATUS))throw new Error(t.getProgramInfoLog(e));return e}var et=25,m=58,F="sfms-robot-participant",w=["left","right"],O={ArrowLeft:"left",ArrowRight:"right",ArrowDown:"neither"},Y={left:"Left",right:"Right",neither:"Cannot tell"},j=new URLSearchParams(location.hash.slice(1)).get("token"),f=t=>document.getElementById(t),R,S,g,I,u,k,A;async function L(t,s={}){let o={"content-type":"application/json",...j?{"x-token":j}:{}},e=await fetch(t,{method:"POST",headers:o,body:JSON.stringify(s)});if(!e.ok)throw new Error((await e.text()).trim());return e.json()}async function V(t){let s=await fetch(t);if(!s.ok)throw new Error(`${t}: ${s.status}`);return s.arrayBuffer()}async function ot(){let t=await L("begin");S=t.questions,R=localStorage.getItem(F)??t.participant,localStorage.setItem(F,R);let s=await V("human/head.bin");I=Object.fromEntries(w.map(o=>[o,new b(f(o),s)])),addEventListener("resize",()=>A||N()),await $(await L("next",{participant:R}))}async function $(t){if(E(),f("count").textContent=`${t.answered} of ${t.trials} answered`,f("progress").max=t.trials,f("progress").value=t.answered,f("trial").hidden=t.trial===void 0,f("done").hidden=t.trial!==void 0,t.trial===void 0)return;let[s,o]=await Promise.all(w.map(e=>V(`clips/${t[e]}`)));g={number:t.trial,left:new Float32Array(s),right:new Float32Array(o)},f("voice").src=`clips/${t.audio}`,u={},k=new Set,D(),N(),f("play-left").focus()}function N(){for(let t of w)I[t].show(g[t].subarray(0,m))}async function G(t){E(),N();let s=f("voice"),o=g[t],e=o.length/m;s.currentTime=0,A=t,document.body.dataset.playing=t;try{await s.play()}catch(r){return E(),C(`no sound: ${r.message}`)}let n=new Float32Array(m),a=()=>{if(A!==t)return;let r=Math.min(s.currentTime*et,e-1),i=Math.floor(r),c=Math.min(i+1,e-1),l=r-i;for(let h=0;h<m;h++)n[h]=(1-l)*o[i*m+h]+l*o[c*m+h];I[t].show(n),s.ended?(k.add(t),E(),D()):requestAnimationFrame(a)};requestAnimationFrame(a)}function E(){A=void 0,delete document.body.dataset.playing,f("voice").pause()}function D(){let t=k.size===2;f("hint").textContent=t?"Your answer: arrow left, arrow right, or arrow down for neither.":"Watch both to their end first: keys 1 and 2.";let s=Object.entries(S).map(([o,e])=>{let n=document.createElement("fieldset");n.disabled=!t;let a=document.createElement("legend");return a.textContent=e,n.append(a,...Object.keys(Y).map(r=>st(o,r))),n});f("questions").replaceChildren(...s),t&&f("questions").querySelector("button:not([aria-pressed=true])")?.focus()}function st(t,s){let o=document.createElement("button");return o.type="button",o.textContent=Y[s],o.setAttribute("aria-pressed",u[t]===s),o.addEventListener("click",()=>H(t,s)),o}async function H(t,s){if(u[t]=s,D(),!(Object.keys(u).length<Object.keys(S).length))try{await $(await L("answer",{participant:R,trial:g.number,answers:u}))}catch(o){C(`${o.message}; not saved: choose again`)}}function C(t){f("say").textContent=t}addEventListener("keydown",t=>{if(!(!g||f("trial").hidden||t.ctrlKey||t.metaKey||t.altKey)){if(t.key==="1"||t.key==="2")G(w[Number(t.key)-1]);else if(O[t.key]&&k.size===2){let s=Object.keys(S).find(o=>!u[o]);s&&H(s,O[t.key])}else return;t.preventDefault()}});for(let t of w)f(`play-${t}`).addEventListener("click",()=>G(t));f("another").addEventListener("click",()=>{localStorage.removeItem(F),location.reload()});ot().catch(t=>C(t.message));
