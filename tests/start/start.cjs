// Measures the user's waiting time after starting the program. See `run`.
//
//   node start.cjs VIZFLYT [--json]

const { spawn, spawnSync } = require("node:child_process");
const fs = require("node:fs");
const net = require("node:net");
const os = require("node:os");
const path = require("node:path");
const { chromium } = require("playwright-core");

const [vizflyt, json] = process.argv.slice(2);
const HELPS = 20, DEMOS = 5, PAGES = 5;
/** How long an idle server is watched. [ms] */
const IDLE_MS = 10_000;
/** Bounds what never comes. [ms] */
const PATIENCE_MS = 60_000;
const scratch = fs.mkdtempSync(path.join(os.tmpdir(), "vizflyt-start-"));
const children = new Set();

/** Starts the program, with a cache of its own in `caches`; `line` waits for a line of its output, `end` ends it. */
function start(args, caches) {
  const env = { ...process.env, XDG_CACHE_HOME: caches };
  const child = spawn(vizflyt, args, { stdio: ["pipe", "pipe", "ignore"], env, cwd: scratch });
  children.add(child);
  const ended = new Promise((done) => child.on("exit", done));
  let text = "";
  const line = (pattern) =>
    new Promise((done, fail) => {
      const look = (bytes = "") => {
        text += bytes;
        const found = text.match(pattern);
        if (found) done(found);
      };
      child.stdout.on("data", look);
      ended.then(() => fail(new Error(`vizflyt ${args.join(" ")} ended without ${pattern}:\n${text}`)));
      look();
    });
  const end = async () => {
    child.kill("SIGTERM");
    await ended;
    children.delete(child);
  };
  return { child, line, end };
}

/** Waits for the first image that a server sends to a page: a binary message (RFC 6455) on its WebSocket. */
function firstImage(url) {
  const { hostname, port, host } = new URL(url);
  return new Promise((done, fail) => {
    const socket = net.connect(Number(port), hostname);
    socket.setTimeout(PATIENCE_MS, () => socket.destroy(new Error(`no image from ${url}`)));
    socket.write(
      `GET /ws HTTP/1.1\r\nHost: ${host}\r\nOrigin: http://${host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n` +
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
    );
    let open = false, rest = Buffer.alloc(0);
    socket.on("data", (bytes) => {
      rest = Buffer.concat([rest, bytes]);
      if (!open) {
        const head = rest.indexOf("\r\n\r\n");
        if (head < 0) return;
        const text = rest.toString("latin1");
        if (!text.startsWith("HTTP/1.1 101 ")) return socket.destroy(new Error(text));
        open = true;
        rest = rest.subarray(head + 4);
      }
      // Unfragmented, unmasked frames; the bytes after the second hold the length of a long one.
      while (rest.length >= 10) {
        const short = rest[1] & 0x7f;
        const [head, length] =
          short < 126 ? [2, short] : short === 126 ? [4, rest.readUInt16BE(2)] : [10, Number(rest.readBigUInt64BE(2))];
        if ((rest[0] & 0x0f) === 2) {
          socket.destroy();
          return done();
        }
        if (rest.length < head + length) return;
        rest = rest.subarray(head + length);
      }
    });
    socket.on("error", fail);
    socket.on("close", () => fail(new Error(`${url} closed before its first image`)));
  });
}

/** Returns how long `vizflyt demo` takes to report its page, to its first image, and until the plugin flies. [ms] */
async function demo(caches) {
  const began = performance.now();
  const lab = start(["demo", "--headless"], caches);
  const [, url] = await lab.line(/^page\s+(\S+)$/m);
  const ready_ms = performance.now() - began;
  await firstImage(url);
  const image_ms = performance.now() - began;
  await lab.line(/the plugin flies/);
  const flies_ms = performance.now() - began;
  await lab.end();
  return { ready_ms, image_ms, flies_ms };
}

/** Returns when a page drew its first picture, in a browser that runs already, from the navigation's start. [ms] */
async function firstPicture(browser, url) {
  const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
  await context.addInitScript(() => {
    const draw = CanvasRenderingContext2D.prototype.drawImage;
    CanvasRenderingContext2D.prototype.drawImage = function (image, ...place) {
      draw.call(this, image, ...place);
      if (image instanceof ImageBitmap) window.drawn_ms ??= performance.now();
    };
  });
  const page = await context.newPage();
  await page.goto(url);
  const drawn_ms = await page.waitForFunction(() => window.drawn_ms, null, { timeout: PATIENCE_MS });
  const value = await drawn_ms.jsonValue();
  await context.close();
  return value;
}

/** Returns the time that a process has taken of processors, with all of its threads. [ms] */
function taken_ms({ pid }) {
  const fields = fs.readFileSync(`/proc/${pid}/stat`, "utf8").split(") ")[1].split(" ");
  // User and system time, in units of 10 ms.
  return 10 * (Number(fields[11]) + Number(fields[12]));
}

/** Returns what of a processor a server takes that nobody watches, while `poses` come or not. [%] */
async function idle(scene, poses) {
  const ports = ["--http", "--quic", "--vicon"].flatMap((port) => [port, "127.0.0.1:0"]);
  const keys = path.join(scratch, "keys");
  const server = start(["serve", scene, ...ports, "--leaderboard", "none", "--keys", keys, "--json"], scratch);
  const ready = JSON.parse((await server.line(/^\{"ready".*$/m))[0]);
  const vehicle = poses ? start(["sim", "--vicon", ready.vicon, "--mavlink", "udpin:127.0.0.1:0"], scratch) : null;
  // Everything after the start is finished.
  await new Promise((done) => setTimeout(done, 2000));
  const before_ms = taken_ms(server.child);
  const began = performance.now();
  await new Promise((done) => setTimeout(done, IDLE_MS));
  const share = (100 * (taken_ms(server.child) - before_ms)) / (performance.now() - began);
  await vehicle?.end();
  await server.end();
  return share;
}

async function measure() {
  const helps = [];
  for (let k = 0; k < HELPS; k++) {
    const began = performance.now();
    const { status } = spawnSync(vizflyt, ["--help"], { stdio: "ignore" });
    if (status !== 0) throw new Error(`vizflyt --help ends with ${status}`);
    helps.push(performance.now() - began);
  }
  const cold = [], warm = [];
  for (let k = 0; k < DEMOS; k++) {
    const caches = path.join(scratch, `caches-${k}`);
    cold.push(await demo(caches));
    warm.push(await demo(caches));
  }
  const lab = start(["demo", "--headless"], path.join(scratch, "caches-0"));
  const [, url] = await lab.line(/^page\s+(\S+)$/m);
  await firstImage(url);
  const executablePath = process.env.CHROMIUM ?? ["/usr/bin/chromium", "/usr/bin/chromium-browser"].find(fs.existsSync);
  // As in tests/page.
  const browser = await chromium.launch({ executablePath, args: ["--no-sandbox", "--enable-unsafe-swiftshader"] });
  const pictures = [];
  for (let k = 0; k < PAGES; k++) pictures.push(await firstPicture(browser, url));
  await browser.close();
  await lab.end();
  const scene = path.join(scratch, "forest");
  spawnSync(vizflyt, ["scene", "generate", "forest", "-o", scene], { stdio: "ignore" });
  const least = (values) => Math.min(...values);
  return [
    ["vizflyt demo to its first image", least(warm.map((d) => d.image_ms)), 1500, "ms"],
    ["of it until the page is there", least(warm.map((d) => d.ready_ms)), null, "ms"],
    ["until the plugin flies", least(warm.map((d) => d.flies_ms)), 4000, "ms"],
    ["the first start of all, nothing kept", least(cold.map((d) => d.image_ms)), null, "ms"],
    ["vizflyt --help", least(helps), 20, "ms"],
    ["the page's first picture", least(pictures), 1000, "ms"],
    ["idle server, no poses", await idle(scene, false), 2, "% of a core"],
    ["idle server, poses at 200 Hz", await idle(scene, true), 2, "% of a core"],
  ];
}

measure()
  .then((rows) => {
    if (json) {
      const figures = rows.map(([what, value, target, unit]) => ({ what, value, target, unit }));
      return console.log(JSON.stringify(figures, null, 2));
    }
    for (const [what, value, target, unit] of rows) {
      const figure = value.toFixed(unit === "ms" ? 0 : 1).padStart(6);
      console.log(`${what.padEnd(38)}${figure} ${unit}${target == null ? "" : `, wanted at most ${target}`}`);
    }
  })
  .catch((error) => {
    console.error(error.message);
    process.exitCode = 1;
  })
  .finally(() => {
    for (const child of children) child.kill("SIGKILL");
    fs.rmSync(scratch, { recursive: true, force: true });
  });
