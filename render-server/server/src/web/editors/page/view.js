// The page requests one image at a time, and only when its camera has moved. If the server is slow, images get smaller;
// when the camera rests, an image of full size follows.

const $ = (id) => document.getElementById(id);
const canvas = $("picture");
const context = canvas.getContext("2d");
const eye = { p: [0, 0, 1], yaw: 0, pitch: 0, fov: 75, depth: false, at_s: 0 };
const keys = new Set();
let playing = false; // Whether the clock of moving objects runs.
let start = null, info = null, socket = null;
let speed_mps = 1.5, share = 0.5, shownShare = 0;
let stale = true, waiting = false, movedAt = 0, before = performance.now();
let asked = null, hasTool = false;

/** Interface for the tools of the view (align.js, course.js, edit.js). */
export const view = {
  canvas, eye, changed, announce,
  /** Added to every request. */
  extra: {},
  /** Called with a request and the description of its image, after it is shown. */
  listeners: [],
};

// ---- the connection --------------------------------------------------------------------------
function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => (typeof data === "string" ? handleMessage(JSON.parse(data)) : show(data));
  socket.onclose = () => {
    waiting = false;
    announce("connection lost; restart the server, and this page reconnects", true);
    setTimeout(connect, 1000);
  };
}

function handleMessage(message) {
  if (message.error) {
    waiting = false;
    return announce(message.error);
  }
  if (message.start_m) {
    $("announcement").hidden = true;
    document.title = `${message.name} · VizFlyt`;
    $("name").textContent = message.name;
    $("facts").textContent = `${message.splats.toLocaleString("en")} splats · ${message.renderer.name} (${message.renderer.reason})`;
    $("clock").hidden = !message.objects;
    if (!start) {
      start = { p: message.start_m, yaw: message.yaw_rad };
      home();
    }
    if (message.tool && !hasTool) import(message.tool).catch((error) => announce(error.message, true));
    hasTool ||= !!message.tool;
    waiting = false;
    stale = true;
    return;
  }
  info = message;
}

async function show(data) {
  try {
    const image = await createImageBitmap(new Blob([data], { type: "image/jpeg" }));
    const [width, height] = [innerWidth, innerHeight].map((side) => Math.round(side * ratio()));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    context.imageSmoothingQuality = "high";
    context.drawImage(image, 0, 0, width, height);
    image.close();
  } catch {
    stale = true; // Request another image if this one does not decode.
  }
  waiting = false;
  const middle = info.middle_m == null ? "" : ` · ${info.middle_m.toFixed(2)} m ahead`;
  $("where").textContent = `x ${eye.p[0].toFixed(2)}  y ${eye.p[1].toFixed(2)}  z ${eye.p[2].toFixed(2)} m${middle}`;
  $("figures").textContent = `${info.camera.w} × ${info.camera.h} in ${info.ms.toFixed(1)} ms · ${info.visible.toLocaleString("en")} splats in sight`;
  for (const listener of view.listeners) listener(asked, info);
  document.body.dataset.pictures = +(document.body.dataset.pictures ?? 0) + 1;
  if (moving()) {
    // About 20 images per second, at the highest possible resolution.
    if (info.ms > 45) share = Math.max(0.2, share * 0.85);
    else if (info.ms < 25) share = Math.min(1, share * 1.12);
  }
}

const ratio = () => Math.min(devicePixelRatio || 1, 1920 / Math.max(innerWidth, innerHeight));
const moving = () => performance.now() - movedAt < 250;

function ask() {
  const wanted = moving() ? share : 1;
  if (!start || waiting || socket?.readyState !== WebSocket.OPEN) return;
  if (!stale && wanted <= shownShare) return;
  const side = (length) => Math.max(16, Math.round(length * ratio() * wanted));
  asked = {
    p_m: eye.p, yaw_rad: eye.yaw, pitch_rad: eye.pitch, fov_deg: eye.fov,
    width_px: side(innerWidth), height_px: side(innerHeight), depth: eye.depth, at_s: eye.at_s, ...view.extra,
  };
  socket.send(JSON.stringify(asked));
  [waiting, stale, shownShare] = [true, false, wanted];
}

// ---- flying ----------------------------------------------------------------------------------
function changed(inMotion = true) {
  stale = true;
  if (inMotion) movedAt = performance.now();
}

/** Moves along the axes of the view. [m] */
function move(ahead, left, up) {
  const [c, s] = [Math.cos(eye.yaw), Math.sin(eye.yaw)];
  const [level, rise] = [Math.cos(eye.pitch), Math.sin(eye.pitch)];
  eye.p = [
    eye.p[0] + ahead * c * level - left * s,
    eye.p[1] + ahead * s * level + left * c,
    eye.p[2] + ahead * rise + up,
  ].map((value) => Math.min(1e5, Math.max(-1e5, value)));
  changed();
}

function look(left, up) {
  eye.yaw += left;
  eye.pitch = Math.min(1.55, Math.max(-1.55, eye.pitch + up));
  changed();
}

function passTime(dt_s) {
  eye.at_s += dt_s;
  $("time").textContent = `${eye.at_s.toFixed(1)} s`;
  changed();
}

function home() {
  [eye.p, eye.yaw, eye.pitch] = [[...start.p], start.yaw, 0];
  changed(false);
}

function turn(now) {
  const dt_s = Math.min(0.1, (now - before) / 1000);
  before = now;
  const axis = (plus, minus) => plus.some((key) => keys.has(key)) - minus.some((key) => keys.has(key));
  const ahead = axis(["KeyW", "ArrowUp"], ["KeyS", "ArrowDown"]);
  const left = axis(["KeyA", "ArrowLeft"], ["KeyD", "ArrowRight"]);
  const up = axis(["KeyE", "Space"], ["KeyQ"]);
  const step = speed_mps * dt_s * (keys.has("ShiftLeft") || keys.has("ShiftRight") ? 4 : 1);
  if (ahead || left || up) move(ahead * step, left * step, up * step);
  if (playing) passTime(dt_s);
  ask();
  requestAnimationFrame(turn);
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target instanceof HTMLInputElement) return;
  if (event.code === "Space" && event.target instanceof HTMLButtonElement) return;
  if (event.code.startsWith("Arrow") || event.code === "Space") event.preventDefault();
  if (event.code === "KeyR" && !event.repeat && start) home();
  keys.add(event.code);
});
addEventListener("keyup", (event) => keys.delete(event.code));
addEventListener("blur", () => keys.clear());
addEventListener("resize", () => changed(false));

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  canvas.focus();
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
});
for (const end of ["pointerup", "pointercancel"])
  canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("pointermove", (event) => {
  const last = fingers.get(event.pointerId);
  if (!last) return;
  const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
  const apart = spread();
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  if (fingers.size === 1) {
    const rad_per_px = (eye.fov * Math.PI) / 180 / innerWidth;
    look(dx * rad_per_px, dy * rad_per_px);
  } else if (fingers.size === 2) {
    const m_per_px = speed_mps / 200;
    move((spread() - apart) * m_per_px * 2, (dx * m_per_px) / 2, (dy * m_per_px) / 2);
  }
});
function spread() {
  if (fingers.size !== 2) return 0;
  const [a, b] = [...fingers.values()];
  return Math.hypot(a[0] - b[0], a[1] - b[1]);
}
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  setSpeed(speed_mps * (event.deltaY < 0 ? 1.2 : 1 / 1.2));
}, { passive: false });
function setSpeed(mps) {
  speed_mps = Math.min(100, Math.max(0.05, mps));
  $("speed").textContent = `${speed_mps.toFixed(speed_mps < 1 ? 2 : 1)} m/s`;
}
setSpeed(speed_mps);

// ---- buttons ---------------------------------------------------------------------------------
function shows(depth) {
  eye.depth = depth;
  $("colour").setAttribute("aria-pressed", !depth);
  $("depth").setAttribute("aria-pressed", depth);
  $("scale").hidden = !depth;
  changed(false);
}
$("colour").onclick = () => shows(false);
$("depth").onclick = () => shows(true);
$("play").onclick = () => {
  playing = !playing;
  $("play").setAttribute("aria-pressed", playing);
};
$("home").onclick = () => start && home();
$("fov").oninput = ({ target }) => {
  eye.fov = +target.value;
  $("fov-text").textContent = `${eye.fov}°`;
  changed();
};
$("copy").onclick = async () => {
  if (!info) return;
  const text = JSON.stringify(info.camera);
  try {
    await navigator.clipboard.writeText(text);
    const at = $("clock").hidden ? "" : ` --at ${eye.at_s.toFixed(2)}`;
    announce(`copied; save it as cam.json, then: vizflyt scene render SCENE --camera cam.json${at}`);
  } catch {
    announce(text, true);
  }
};
let hideTimer = 0;
function announce(text, stays) {
  $("announcement").textContent = text;
  $("announcement").hidden = false;
  clearTimeout(hideTimer);
  if (!stays) hideTimer = setTimeout(() => ($("announcement").hidden = true), 6000);
}

connect();
requestAnimationFrame(turn);
