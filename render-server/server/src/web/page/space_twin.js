// The twin in the 3D view: its splats, drawn back to front. Splats beyond a side of the fence that the camera is beyond
// are omitted, so that the view into a room is not blocked by its near walls and ceiling.

import * as THREE from "/three/three.module.min.js";
import { ROW, TEXELS } from "./splats.js";

/** Sort again if the camera has turned by more than this. [cosine; 1 degree] */
const SAME_DIRECTION = Math.cos(Math.PI / 180);

const VERTEX = /* glsl */ `
precision highp float;
uniform highp sampler2D splats;
uniform vec2 viewport; // [px]
uniform vec3 eye; // of the camera, in the fence's axes from its middle [m]
uniform vec3 fenceHalf;
uniform vec3 fenceMiddle;
uniform mat3 fenceFromWorld;
in float place;
out vec2 at; // [standard deviations]
out vec4 colour;

bool isCut(vec3 mean) {
  vec3 p = fenceFromWorld * (mean - fenceMiddle) * sign(eye);
  return any(bvec3(vec3(greaterThan(abs(eye), fenceHalf)) * vec3(greaterThan(p, fenceHalf))));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int k = int(place);
  ivec2 texel = ivec2(${TEXELS} * (k % ${ROW}), k / ${ROW});
  vec4 mean = texelFetch(splats, texel, 0);
  vec3 camera = (viewMatrix * vec4(mean.xyz, 1.0)).xyz;
  float depth = -camera.z;
  if (depth < 0.1 || isCut(mean.xyz)) return;
  vec4 clip = projectionMatrix * vec4(camera, 1.0);
  if (any(greaterThan(abs(clip.xy), vec2(1.3 * clip.w)))) return;
  vec4 first = texelFetch(splats, texel + ivec2(1, 0), 0);
  vec4 second = texelFetch(splats, texel + ivec2(2, 0), 0);
  mat3 spread = mat3(first.x, first.y, first.z, first.y, first.w, second.x, first.z, second.x, second.y);
  vec2 focal = vec2(projectionMatrix[0][0], projectionMatrix[1][1]) * viewport / 2.0;
  // The projection's derivative at the centre (Zwicker and others, "EWA volume splatting", 2001).
  mat3 turn = mat3(viewMatrix);
  vec3 across = vec3(focal.x / depth, 0.0, focal.x * camera.x / (depth * depth)) * turn;
  vec3 above = vec3(0.0, focal.y / depth, focal.y * camera.y / (depth * depth)) * turn;
  // Minimum width of one pixel, as in the server's renderers. [px^2]
  float xx = dot(across, spread * across) + 0.3;
  float yy = dot(above, spread * above) + 0.3;
  float xy = dot(across, spread * above);
  float mid = (xx + yy) / 2.0;
  float away = length(vec2((xx - yy) / 2.0, xy));
  float longer = mid + away;
  float shorter = max(0.1, mid - away);
  vec2 axis = abs(xy) > 1e-6 ? normalize(vec2(xy, longer - xx)) : xx > yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  // Radius at which a splat is fainter than one step of colour.
  at = position.xy * sqrt(2.0 * log(max(1.01, 255.0 * mean.w)));
  vec2 offset = at.x * min(sqrt(longer), 512.0) * axis + at.y * min(sqrt(shorter), 512.0) * vec2(-axis.y, axis.x);
  gl_Position = vec4(clip.xy / clip.w + 2.0 * offset / viewport, clip.z / clip.w, 1.0);
  int rgb = int(second.z);
  colour = vec4(vec3(rgb / 65536, rgb / 256 % 256, rgb % 256) / 255.0, mean.w);
}`;

const FRAGMENT = /* glsl */ `
precision highp float;
in vec2 at;
in vec4 colour;
out vec4 shown;
void main() {
  float alpha = colour.a * exp(-0.5 * dot(at, at));
  if (alpha < 1.0 / 255.0) discard;
  shown = vec4(colour.rgb * alpha, alpha);
}`;

export class Twin {
  /**
   * Fetches the twin and draws it from its first part on.
   * @param {import("./messages").Arena} arena
   * @param {number} parts number of parts to fetch
   * @param {() => void} shown called once, when the first part is visible
   */
  constructor(arena, parts, shown) {
    this.geometry = new THREE.InstancedBufferGeometry();
    const corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]];
    this.geometry.setAttribute("position", new THREE.Float32BufferAttribute(corners.flat(), 3));
    this.geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.geometry.instanceCount = 0;
    this.material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, transparent: true, depthWrite: false,
      blending: THREE.CustomBlending, blendSrc: THREE.OneFactor, blendDst: THREE.OneMinusSrcAlphaFactor, premultipliedAlpha: true,
      uniforms: {
        splats: { value: null },
        viewport: { value: new THREE.Vector2() },
        eye: { value: new THREE.Vector3() },
        fenceHalf: { value: new THREE.Vector3() },
        fenceMiddle: { value: new THREE.Vector3() },
        fenceFromWorld: { value: new THREE.Matrix3() },
      },
    });
    this.mesh = new THREE.Mesh(this.geometry, this.material);
    this.mesh.frustumCulled = false;
    // Drawn before other transparent objects: panes of stages are in front of it.
    this.mesh.renderOrder = -1;
    /** Direction of the camera at the last sort request. @type {THREE.Vector3 | null} */
    this.ordered = null;
    this.waits = false;
    this.isShown = false;
    this.worker = new Worker("/splat_worker.js", { type: "module" });
    this.worker.addEventListener("message", ({ data }) => {
      if (data.texels) this.setTexels(data.texels);
      else if (this.setOrder(data.order)) shown();
    });
    this.worker.postMessage({ parts, boot: arena.boot });
  }

  /** @param {Float32Array} texels as of `readSpz` */
  setTexels(texels) {
    const rows = Math.max(1, Math.ceil(texels.length / 4 / TEXELS / ROW));
    const data = new Float32Array(4 * TEXELS * ROW * rows);
    data.set(texels);
    const texture = new THREE.DataTexture(data, TEXELS * ROW, rows, THREE.RGBAFormat, THREE.FloatType);
    texture.needsUpdate = true;
    this.material.uniforms.splats.value?.dispose();
    this.material.uniforms.splats.value = texture;
    // The old order does not contain the new splats.
    this.ordered = null;
  }

  /** Sets a new order; returns whether it is the first. @param {Float32Array} order */
  setOrder(order) {
    this.waits = false;
    const former = this.geometry.getAttribute("place");
    if (former?.array.length === order.length) {
      former.array.set(order);
      former.needsUpdate = true;
    } else {
      // The size of a buffer is fixed.
      if (former) this.geometry.dispose();
      this.geometry.setAttribute("place", new THREE.InstancedBufferAttribute(order, 1));
    }
    this.geometry.instanceCount = order.length;
    const first = !this.isShown;
    this.isShown = true;
    return first;
  }

  /**
   * Prepares a frame.
   * @param {THREE.PerspectiveCamera} camera
   * @param {THREE.Vector2} viewport [px]
   * @param {import("./space_room.js").Room} room
   * @param {boolean} cut whether to omit what is between camera and fence
   */
  place(camera, viewport, room, cut) {
    const { uniforms } = this.material;
    const world = new THREE.Matrix4().makeRotationFromQuaternion(room.fenceTurn.clone().invert());
    uniforms.viewport.value.copy(viewport);
    uniforms.fenceFromWorld.value.setFromMatrix4(world);
    uniforms.fenceMiddle.value.copy(room.middle);
    uniforms.fenceHalf.value.set(...room.size).multiplyScalar(0.5);
    // From the middle, nothing is cut.
    uniforms.eye.value.copy(cut ? camera.position : room.middle).sub(room.middle).applyMatrix3(uniforms.fenceFromWorld.value);
    const ahead = camera.getWorldDirection(new THREE.Vector3());
    if (!uniforms.splats.value || this.waits || (this.ordered && this.ordered.dot(ahead) > SAME_DIRECTION)) return;
    this.ordered = ahead;
    this.waits = true;
    this.worker.postMessage({ ahead: ahead.toArray() });
  }

  dispose() {
    this.worker.terminate();
    this.geometry.dispose();
    this.material.uniforms.splats.value?.dispose();
    this.material.dispose();
  }
}
