// Draws the 3D view without a graphics card: lines and faces of a scene over an image, the farthest first. The image
// does not hide them. Supports basic and matte materials of three.js.

import * as THREE from "/three/three.module.min.js";
import { context2d } from "./dom.js";

/** Direction of the light, and brightness of faces turned away from it. */
const SUN = new THREE.Vector3(-0.4, -0.7, 1).normalize(), AMBIENT = 0.55;
/** [CSS px] */
const LINE_PX = 1.5;
/** Segments of a line that are sorted and drawn together. */
const TOGETHER = 12;
/** Opacity of an image of another camera. */
const FORMER = 0.3;

/**
 * Shape that is drawn at once: paths, filled or as lines.
 * @typedef {{ depth: number, style: string, alpha: number, filled: boolean, paths: [x: number, y: number][][] }} Shape
 */

export class FlatRenderer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.g = context2d(canvas);
    this.ratio = 1;
    /** @type {Shape[]} */
    this.shapes = [];
    /** Styles by colour, in 32 steps a channel. @type {Map<number, string>} */
    this.styles = new Map();
  }

  /** @param {number} ratio device pixels per CSS pixel */
  setPixelRatio(ratio) {
    this.ratio = ratio;
  }

  /** @param {number} width [CSS px] @param {number} height [CSS px] */
  setSize(width, height) {
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(height * this.ratio);
  }

  /** @param {THREE.Vector2} size */
  getDrawingBufferSize(size) {
    return size.set(this.canvas.width, this.canvas.height);
  }

  /**
   * @param {THREE.Scene} scene
   * @param {THREE.PerspectiveCamera} camera
   * @param {ImageBitmap | undefined} picture
   * @param {boolean} isCurrent whether the picture shows this camera's view
   */
  render(scene, camera, picture, isCurrent) {
    scene.updateMatrixWorld();
    camera.updateMatrixWorld();
    this.shapes.length = 0;
    scene.traverseVisible((node) => {
      if (node instanceof THREE.Mesh) this.addFaces(node, camera);
      else if (node instanceof THREE.Line) this.addLine(node, camera);
    });
    this.shapes.sort((a, b) => b.depth - a.depth);
    const { g, canvas: { width, height } } = this;
    g.clearRect(0, 0, width, height);
    g.globalAlpha = isCurrent ? 1 : FORMER;
    if (picture) g.drawImage(picture, 0, 0, width, height);
    g.lineWidth = LINE_PX * this.ratio;
    g.lineJoin = "round";
    for (const shape of this.shapes) this.draw(shape);
    g.globalAlpha = 1;
  }

  /** @param {Shape} shape */
  draw({ style, alpha, filled, paths }) {
    const { g } = this;
    g.globalAlpha = alpha;
    g.fillStyle = g.strokeStyle = style;
    g.beginPath();
    for (const [first, ...rest] of paths) {
      g.moveTo(...first);
      for (const at of rest) g.lineTo(...at);
      if (filled) g.closePath();
    }
    if (filled) g.fill();
    else g.stroke();
  }

  /** @param {THREE.Mesh} mesh @param {THREE.PerspectiveCamera} camera */
  addFaces(mesh, camera) {
    const { geometry, material } = mesh;
    if (!(material instanceof THREE.MeshBasicMaterial || material instanceof THREE.MeshLambertMaterial)) return;
    const { position } = geometry.attributes, { index } = geometry;
    const toView = new THREE.Matrix4().multiplyMatrices(camera.matrixWorldInverse, mesh.matrixWorld);
    const corners = Array.from({ length: position.count }, (_, k) => new THREE.Vector3().fromBufferAttribute(position, k).applyMatrix4(toView));
    const sun = SUN.clone().transformDirection(camera.matrixWorldInverse);
    /** All faces of a transparent mesh are one shape, so that no edges show between them. @type {Shape} */
    const whole = { depth: 0, style: this.style(material.color, 1), alpha: material.opacity, filled: true, paths: [] };
    const normal = new THREE.Vector3(), other = new THREE.Vector3();
    for (let k = 0; k < (index?.count ?? position.count); k += 3) {
      const [a, b, c] = [k, k + 1, k + 2].map((at) => corners[index ? index.getX(at) : at]);
      // Skip the small faces that reach behind the camera.
      if (Math.max(a.z, b.z, c.z) > -camera.near) continue;
      normal.subVectors(b, a).cross(other.subVectors(c, a)).normalize();
      if (material.side === THREE.FrontSide && normal.dot(a) >= 0) continue;
      const path = [a, b, c].map((p) => this.project(p, camera));
      const depth = -(a.z + b.z + c.z) / 3;
      if (material.transparent) {
        whole.paths.push(path);
        whole.depth = Math.max(whole.depth, depth);
        continue;
      }
      const light = material instanceof THREE.MeshLambertMaterial ? AMBIENT + ((1 - AMBIENT) * (1 + normal.dot(sun))) / 2 : 1;
      this.shapes.push({ depth, style: this.style(material.color, light), alpha: 1, filled: true, paths: [path] });
    }
    if (whole.paths.length) this.shapes.push(whole);
  }

  /** @param {THREE.Line} line @param {THREE.PerspectiveCamera} camera */
  addLine(line, camera) {
    const { geometry, material } = line;
    if (!(material instanceof THREE.LineBasicMaterial)) return;
    const { position, color } = geometry.attributes;
    const count = Math.min(position.count, geometry.drawRange.count);
    const toView = new THREE.Matrix4().multiplyMatrices(camera.matrixWorldInverse, line.matrixWorld);
    const points = Array.from({ length: count }, (_, k) => new THREE.Vector3().fromBufferAttribute(position, k).applyMatrix4(toView));
    if (line instanceof THREE.LineLoop && count) points.push(points[0]);
    const step = line instanceof THREE.LineSegments ? 2 : 1;
    const paint = new THREE.Color();
    /** Previous segment that the next one continues. @type {{ shape: Shape, length: number } | null} */
    let former = null;
    for (let k = 0; k + 1 < points.length; k += step) {
      const style = this.style(color ? paint.setRGB(color.getX(k), color.getY(k), color.getZ(k)) : material.color, 1);
      const ends = inSight(points[k], points[k + 1], camera.near);
      if (!ends) {
        former = null;
        continue;
      }
      const [from, to] = ends;
      const goesOn = former && step === 1 && former.length < TOGETHER && former.shape.style === style && from === points[k];
      if (!goesOn) {
        former = { shape: { depth: 0, style, alpha: 1, filled: false, paths: [[this.project(from, camera)]] }, length: 0 };
        this.shapes.push(former.shape);
      }
      if (!former) continue;
      former.shape.paths[0].push(this.project(to, camera));
      former.shape.depth = Math.max(former.shape.depth, -(from.z + to.z) / 2);
      former.length++;
      if (to !== points[k + 1]) former = null;
    }
  }

  /** Returns the position of a point on the canvas. @param {THREE.Vector3} p_view @param {THREE.PerspectiveCamera} camera @returns {[x: number, y: number]} [px] */
  project(p_view, camera) {
    const { x, y } = p_view.clone().applyMatrix4(camera.projectionMatrix);
    return [((1 + x) / 2) * this.canvas.width, ((1 - y) / 2) * this.canvas.height];
  }

  /** @param {THREE.Color} colour @param {number} light */
  style({ r, g, b }, light) {
    const [red, green, blue] = [r, g, b].map((level) => Math.round(31 * Math.min(1, Math.sqrt(level * light))));
    const key = (red << 10) | (green << 5) | blue;
    let style = this.styles.get(key);
    if (!style) {
      style = new THREE.Color((red / 31) ** 2, (green / 31) ** 2, (blue / 31) ** 2).getStyle();
      this.styles.set(key, style);
    }
    return style;
  }

  dispose() {
    this.shapes.length = 0;
  }
}

/**
 * Returns the part of a segment in front of the camera; null if it is entirely behind.
 * @param {THREE.Vector3} a
 * @param {THREE.Vector3} b
 * @param {number} near [m]
 * @returns {[THREE.Vector3, THREE.Vector3] | null}
 */
function inSight(a, b, near) {
  const [isA, isB] = [a.z <= -near, b.z <= -near];
  if (!isA && !isB) return null;
  if (isA && isB) return [a, b];
  const between = a.clone().lerp(b, (-near - a.z) / (b.z - a.z));
  return isA ? [a, between] : [between, b];
}
