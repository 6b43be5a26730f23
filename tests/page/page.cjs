// The page in a real, headless Chromium, against the real program. See `run`.
//
//   node page.cjs VIZFLYT [SHOTS [TEST]]

const assert = require("node:assert/strict");
const { spawn, spawnSync } = require("node:child_process");
const fs = require("node:fs");
const os = require("node:os");
const path = require("node:path");
const { chromium } = require("playwright-core");

const [vizflyt, shots, only] = process.argv.slice(2);
/** Bounds a test that fails; a passing one waits for what it waits for. [ms] */
const PATIENCE = 120_000;
/** Finds barriers; run in the page. */
const axe = fs.readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const chromiumPath = process.env.CHROMIUM ?? ["/usr/bin/chromium", "/usr/bin/chromium-browser"].find(fs.existsSync);
const SIZES = { laptop: [1440, 900], phone: [390, 844], projector: [1920, 1080] };
/** How `misbehave` flies the race past the gap, into the wall's middle: straight on, it would miss or meet the edge of a post. */
const INTO_THE_WALL = "world:1:-0.16";
const scratch = fs.mkdtempSync(path.join(os.tmpdir(), "vizflyt-page-"));
const children = [];

/** Starts the program; returns a way to wait for a line of its standard output. */
function start(...args) {
  const child = spawn(vizflyt, args, { stdio: ["pipe", "pipe", "inherit"] });
  children.push(child);
  const lines = [], waiting = new Set();
  let rest = "";
  child.stdout.on("data", (bytes) => {
    const parts = (rest + bytes).split(/\r?\n|\r/);
    rest = parts.pop();
    lines.push(...parts);
    for (const look of waiting) look();
  });
  const ended = new Promise((done) => child.on("exit", done));
  const line = (pattern) =>
    new Promise((done, fail) => {
      const timer = setTimeout(() => fail(new Error(`no line ${pattern} in:\n${lines.join("\n")}`)), PATIENCE);
      const look = () => {
        const found = lines.map((text) => text.match(pattern)).find(Boolean);
        if (!found) return;
        clearTimeout(timer);
        waiting.delete(look);
        done(found);
      };
      waiting.add(look);
      look();
    });
  return { child, line, ended };
}

/** Starts a demo that waits for its start. It draws no more than the page shows: what draws for nobody takes Chromium's time. */
const startDemo = (...args) => start("demo", "--headless", "--wait", "--scene", "race", "--max-rate", "30", ...args);

/** Opens a page of its own that notes what it should not do. */
async function open(browser, url, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1440, height: 900 }, ...options });
  const page = await context.newPage();
  page.setDefaultTimeout(PATIENCE);
  page.faults = [];
  page.on("pageerror", (error) => page.faults.push(`error: ${error.message}`));
  page.on("request", (request) => {
    const to = new URL(request.url());
    // With the Internet unplugged all is there: nothing is asked of anyone else.
    if (!["blob:", "data:"].includes(to.protocol) && to.host !== new URL(url).host) page.faults.push(`asks ${to.host}`);
  });
  await page.goto(url);
  return page;
}

const text = (page, id) => page.locator(`#${id}`).innerText();
const until = (page, id, pattern) =>
  page.waitForFunction(([id, source]) => new RegExp(source).test(document.getElementById(id)?.textContent ?? ""), [id, pattern.source]);

async function shot(page, name) {
  if (shots) await page.screenshot({ path: path.join(shots, `${name}.png`) });
}

/** Everything that can be pressed or filled has a label, and the stop button is in sight. */
async function checkAccess(page, size) {
  const nameless = await page.evaluate(() =>
    [...document.querySelectorAll("button, input, select, a[href], canvas, summary")]
      .filter((node) => node.checkVisibility() && node.getAttribute("aria-hidden") !== "true")
      .filter((node) => !(node.ariaLabel || node.textContent.trim() || node.labels?.[0]?.textContent.trim()))
      .map((node) => node.outerHTML),
  );
  assert.deepEqual(nameless, [], `${size}: without a name`);
  const stop = await page.locator("#estop").boundingBox();
  const [width, height] = SIZES[size];
  assert.ok(stop.x >= 0 && stop.x + stop.width <= width + 1, `${size}: STOP at ${JSON.stringify(stop)}`);
  assert.ok(stop.y >= 0 && stop.y + stop.height <= height + 1, `${size}: STOP at ${JSON.stringify(stop)}`);
  assert.ok(stop.height >= 44, `${size}: STOP is ${stop.height} px high`);
  const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  assert.ok(over <= 0, `${size}: ${over} px too wide`);
}

/** Nothing that axe knows bars anybody from what is open, in the dark or in the light. */
async function checkBarriers(page, what) {
  await page.evaluate(axe);
  const found = await page.evaluate(async () => {
    const root = document.documentElement, former = root.dataset.theme, found = [];
    for (const theme of ["dark", "light"]) {
      root.dataset.theme = theme;
      const { violations } = await globalThis.axe.run(document, { resultTypes: ["violations"] });
      for (const { id, nodes } of violations)
        found.push(`${theme}: ${id}: ${nodes.map(({ html, any }) => `${html.slice(0, 80)} ${any[0]?.message ?? ""}`).join("; ")}`);
    }
    root.dataset.theme = former;
    return found;
  });
  assert.deepEqual(found, [], what);
}

/** What opening the page costs: bytes over the wire, and time until the camera's first picture; the former has a bound. */
async function checkLoad(browser, url) {
  const context = await browser.newContext();
  const page = await context.newPage();
  const wire = await context.newCDPSession(page);
  await wire.send("Network.enable");
  let bytes = 0;
  wire.on("Network.loadingFinished", ({ encodedDataLength }) => (bytes += encodedDataLength));
  const began = Date.now();
  // The largest file, which comes last.
  const last = page.waitForResponse((answer) => answer.url().endsWith("/three.core.min.js"), { timeout: PATIENCE });
  await page.goto(url);
  await isPainted(page, "colour");
  const first_s = (Date.now() - began) / 1000;
  await (await last).finished();
  console.log(`      first picture after ${first_s.toFixed(2)} s; ${(bytes / 1e6).toFixed(2)} MB over the wire`);
  assert.ok(bytes > 1e5 && bytes <= 3e6, `${bytes} bytes`);
  await context.close();
}

/** Whether a canvas shows a picture rather than one colour. */
const isPainted = (page, id) =>
  page.waitForFunction((id) => {
    const canvas = document.querySelector(`#${id}`);
    if (!canvas?.width) return false;
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let k = 0; k < data.length; k += 404) seen.add((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
    return seen.size > 20;
  }, id);

/** How bright the colour camera's picture is, 0 to 255. */
const brightness = (page) =>
  page.evaluate(() => {
    const canvas = document.getElementById("colour");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.reduce((sum, value, k) => sum + (k % 4 < 3 ? value : 0), 0) / (data.length * 0.75);
  });

/** A flight: it waits for its start, is watched on three screens, and is stopped by the keyboard. */
async function flight(browser) {
  const demo = startDemo("--log-dir", scratch, "--report", `${scratch}/report.json`);
  const [, url] = await demo.line(/page\s+(http:\S+)/);
  const page = await open(browser, url);
  await until(page, "phase-text", /ready to start/);
  assert.ok(await page.locator("#land").isHidden(), "nothing to land yet");
  // Every screen before the start: nothing flies meanwhile, and the order of what follows is short.
  await isPainted(page, "map");
  // Nothing here has a graphics card: the top view comes first by itself.
  await page.locator("#view-top[aria-pressed=true]").waitFor();
  assert.ok((await page.locator("#stages li").count()) > 0, "stage lights");
  assert.equal(await page.locator("#stages [aria-current]").count(), 1);
  await checkAccess(page, "laptop");
  await page.locator("#theme").click();
  await shot(page, "laptop-other-theme");
  await page.locator("#theme").click();
  await checkBarriers(page, "the page before a flight");
  await checkLoad(browser, url);
  await panels(page);
  await weak(browser, url);
  // Another light is seen with the next images.
  await isPainted(page, "colour");
  const day = await brightness(page);
  await page.locator("#environment").click();
  await page.locator("#environment-choice").selectOption("night");
  for (let k = 0; (await brightness(page)) > 0.6 * day; k += 1) {
    assert.ok(k < PATIENCE / 100, "no night on the picture");
    await page.waitForTimeout(100);
  }
  await page.locator("#environment-choice").selectOption("day");
  await page.locator("dialog[open]").getByRole("button", { name: "close" }).click();
  for (const size of ["phone", "projector", "laptop"]) {
    const [width, height] = SIZES[size];
    await page.setViewportSize({ width, height });
    await checkAccess(page, size);
    await shot(page, `${size}-ready`);
  }
  // By keyboard alone.
  await page.locator("#start").focus();
  await page.keyboard.press("Enter");
  await until(page, "phase-text", /flying|holding/);
  for (const id of ["colour", "depth"]) await isPainted(page, id);
  await until(page, "clock", /^(?!0:00\.0$)\d/);
  await until(page, "poses", /^\d+$/);
  await until(page, "battery", /^\d/);
  await shot(page, "laptop-flying");
  // Someone who types has the space bar; escape stops from anywhere.
  await page.keyboard.press("Escape");
  await until(page, "announcement", /lands/);
  await until(page, "outcome-title", /Stopped by hand|Collision|Left the geofence/);
  await shot(page, "laptop-stopped");
  await checkBarriers(page, "the page after a stop");
  // It is looked at again, also when the program has ended.
  assert.equal(await demo.ended, 1, "a stopped flight is no success");
  await page.locator("#replay-at").fill("1");
  await until(page, "replay-time", /^0:01\.0 of \d:\d\d\.\d$/);
  await page.locator("#replay-play").click();
  await until(page, "replay-play", /^pause$/);
  await page.waitForFunction(() => Number(document.getElementById("replay-at").value) > 1.2);
  for (const [size, [width, height]] of Object.entries(SIZES)) {
    await page.setViewportSize({ width, height });
    await checkAccess(page, size);
    await shot(page, `${size}-replay`);
  }
  await page.locator("#replay-now").click();
  await page.locator("#replay-now").waitFor({ state: "hidden" });
  await keptFlight(page, url);
  assert.deepEqual(page.faults, []);
  await page.context().close();
  assert.equal(JSON.parse(fs.readFileSync(`${scratch}/report.json`)).outcome === "finished", false);
}

/** Waits until the view in space shows a picture of the scene, other than the one before; returns colours of its points. */
const served = (page, before = "") =>
  page.waitForFunction((before) => {
    const canvas = document.getElementById("space");
    const g = canvas?.getContext("2d");
    if (!canvas?.width || !g) return false;
    const { data } = g.getImageData(0, 0, canvas.width, canvas.height);
    const seen = [], step = 4 * Math.ceil(data.length / 4 / 2000);
    for (let k = 0; k < data.length; k += step) seen.push((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
    // Lines, faces and one colour behind them are some tens.
    return new Set(seen).size > 200 && seen.join() !== before && seen.join();
  }, before).then((handle) => handle.jsonValue());

/** A browser without WebGL 2, and one that draws slowly: the server's pictures of the twin, turned by keys, stand in. */
async function weak(browser, url) {
  const without = await chromium.launch({ executablePath: chromiumPath, args: ["--no-sandbox", "--disable-3d-apis"] });
  const page = await open(without, url);
  await page.locator("#view-top[aria-pressed=true]").waitFor();
  await page.locator("#view-space").click();
  await page.getByText("drawn by the server: this browser has no WebGL 2").waitFor();
  let before = await served(page);
  await page.locator("#space").focus();
  for (let k = 0; k < 8; k++) await page.keyboard.press("ArrowRight");
  const answer = await page.waitForResponse((answer) => answer.url().includes("/api/twin?"));
  assert.equal(answer.headers()["content-type"], "image/jpeg");
  before = await served(page, before);
  await page.locator("#view-onboard").click();
  await served(page, before);
  await page.locator("#view-space").click();
  await checkBarriers(page, "the server's picture");
  for (const size of ["phone", "laptop"]) {
    const [width, height] = SIZES[size];
    await page.setViewportSize({ width, height });
    await served(page);
    await checkAccess(page, size);
    await shot(page, `${size}-served`);
  }
  assert.deepEqual(page.faults, []);
  await without.close();
  const slow = await open(browser, url);
  await slow.locator("#view-space").click();
  // Whoever asks first decides what a canvas is drawn with: it has to be the page.
  await slow.waitForFunction(() => !document.getElementById("space").hidden);
  await slow.evaluate(() => document.getElementById("space").getContext("webgl2").getExtension("WEBGL_lose_context").loseContext());
  await slow.getByText("drawn by the server: this browser's graphics have failed").waitFor();
  await served(slow);
  await slow.getByRole("button", { name: "draw here" }).click();
  await slow.getByRole("button", { name: "let the server draw" }).click();
  await slow.getByText("drawn by the server, twice a second at most").waitFor();
  await served(slow);
  await slow.getByRole("button", { name: "draw here" }).click();
  await slow.getByText("drawn by the server").waitFor({ state: "hidden" });
  await slow.waitForFunction(() => document.getElementById("space").getContext("webgl2"));
  assert.deepEqual(slow.faults, []);
  await slow.context().close();
}

/** Panels are closed, moved and kept, by keyboard, and put back; the cameras take the page, and escape gives it back. */
async function panels(page) {
  await page.getByRole("button", { name: "panels" }).press("Enter");
  const dialog = page.getByRole("dialog", { name: "panels" });
  await checkBarriers(page, "the panels' dialog");
  const inColumn = (side) =>
    page.evaluate((side) => [...document.getElementById(side).children].map(({ id, className }) => id || className.split(" ").at(-1)), side);
  const [left, right] = [await inColumn("left"), await inColumn("right")];
  await dialog.getByRole("checkbox", { name: "timing" }).press("Space");
  await dialog.getByRole("button", { name: "figures to the other column" }).press("Enter");
  await dialog.getByRole("button", { name: "events up" }).press("Enter");
  // By mouse: before the first of the other column.
  const row = (name) => dialog.getByRole("listitem").filter({ has: page.getByRole("checkbox", { name, exact: true }) });
  await row("leaderboard").dragTo(row("map"), { targetPosition: { x: 40, y: 3 } });
  await shot(page, "laptop-panels");
  // Escape closes the dialog; it stops nothing.
  await page.keyboard.press("Escape");
  await dialog.waitFor({ state: "hidden" });
  assert.equal(await text(page, "announcement"), "");
  const arranged = [await inColumn("left"), await inColumn("right")];
  assert.ok(!arranged[0].includes("timing") && !arranged[0].includes("figures") && arranged[1].includes("figures"), `${arranged}`);
  assert.ok(arranged[0].length === left.length - 1 && arranged[0][1] === left[0] && !arranged[1].includes(arranged[0][0]), `${arranged}`);
  await page.reload();
  await until(page, "phase-text", /ready to start/);
  assert.deepEqual([await inColumn("left"), await inColumn("right")], arranged);
  await page.getByRole("button", { name: "panels" }).click();
  await dialog.getByRole("button", { name: "reset" }).click();
  assert.deepEqual([await inColumn("left"), await inColumn("right")], [left, right]);
  await dialog.getByRole("button", { name: "close" }).click();
  await page.getByRole("button", { name: "large" }).click();
  await page.locator("#map").waitFor({ state: "hidden" });
  await isPainted(page, "depth");
  for (const size of ["phone", "projector", "laptop"]) {
    const [width, height] = SIZES[size];
    await page.setViewportSize({ width, height });
    await checkAccess(page, size);
    await shot(page, `${size}-cameras`);
  }
  await page.keyboard.press("Escape");
  await page.locator("#map").waitFor({ state: "visible" });
  assert.equal(await text(page, "announcement"), "");
}

/** The flight that a page has watched: a program started anew has it still; it is saved, read again, and flies beside itself. */
async function keptFlight(page, url) {
  const demo = startDemo("--port", new URL(url).port);
  await demo.line(/page\s+http:\S+/);
  await page.reload();
  await until(page, "phase-text", /ready to start/);
  await until(page, "replay-flight", /choose a flight.*(Stopped by hand|Collision|Left the geofence)/);
  assert.ok(await page.locator("#replay-play").isDisabled(), "nothing has been watched yet");
  await page.locator("#replay-flight").selectOption({ index: 1 });
  await page.locator("#replay-at").fill("1");
  await until(page, "replay-time", /^0:01\.0 of \d:\d\d\.\d$/);
  const [saved] = await Promise.all([page.waitForEvent("download"), page.locator("#replay-save").click()]);
  assert.match(saved.suggestedFilename(), /^race-.*\.flight\.json$/);
  const file = path.join(scratch, "again.json");
  await saved.saveAs(file);
  await page.locator("#replay-file").setInputFiles(file);
  await until(page, "replay-flight", /again\.json/);
  await page.locator("#replay-ghost").selectOption({ index: 2 });
  await page.locator("#replay-at").fill("1");
  await shot(page, "laptop-ghost");
  fs.writeFileSync(file, "{}");
  await page.locator("#replay-file").setInputFiles(file);
  await until(page, "outcome-text", /again\.json: the file is no flight of VizFlyt/);
  demo.child.kill("SIGINT");
  await demo.ended;
}

/** A flight that flies straight into a wall: its crash card comes by itself, and is looked at by keyboard alone. */
async function crash(browser) {
  const misbehave = path.join(path.dirname(vizflyt), "examples", "misbehave");
  assert.ok(fs.existsSync(misbehave), `no ${misbehave}: cargo build --examples`);
  // A plugin sees its own folder alone, as nobody.
  fs.chmodSync(scratch, 0o755);
  const plugin = path.join(scratch, "into-the-wall");
  fs.copyFileSync(misbehave, path.join(scratch, "misbehave"));
  fs.writeFileSync(plugin, `#!/bin/sh\nexec "$(dirname "$0")/misbehave" ${INTO_THE_WALL} "$@"\n`, { mode: 0o755 });
  const demo = startDemo("--plugin", plugin, "--log-dir", scratch);
  const [, url] = await demo.line(/page\s+(http:\S+)/);
  const page = await open(browser, url);
  await until(page, "phase-text", /ready to start/);
  assert.ok(await page.locator("#crash").isHidden(), "nothing has crashed yet");
  await page.locator("#start").click();
  await until(page, "outcome-title", /Collision/);
  const card = page.getByRole("region", { name: "Collision" });
  await card.waitFor();
  const region = page.locator("#crash");
  assert.ok((await region.locator(".cause").innerText()).length > 20, "a probable cause");
  assert.match(await text(page, "crash-when"), /s after take-off, \d of \d stages/);
  const { cause, images, samples } = await page.evaluate(async () => {
    const [{ name }] = await (await fetch("/api/vehicles")).json();
    return (await fetch(`/api/vehicles/${name}/crash`)).json();
  });
  assert.equal(await region.locator(".cause").innerText(), cause);
  const count = images[0].before_s.length;
  assert.ok(count >= 5 && images[0].before_s[0] > 1, `${count} images`);
  assert.ok(samples.length > 100 && samples.at(-1).clearance_m < 0.05, JSON.stringify(samples.at(-1)));
  for (const name of ["clearance and speed before the end", "the place from above"])
    assert.ok(await region.getByRole("img", { name }).isVisible(), name);
  // It plays by itself until someone stops it; then image by image.
  const seen = () => page.evaluate(() => document.querySelector("#crash img").naturalWidth);
  await page.waitForFunction(() => document.querySelector("#crash img").naturalWidth > 100);
  await region.getByRole("button", { name: "pause" }).focus();
  await page.keyboard.press("Enter");
  await region.getByRole("button", { name: "play" }).waitFor();
  const slider = region.getByRole("slider", { name: "time of the image" });
  await slider.focus();
  await page.keyboard.press("End");
  assert.match(await slider.getAttribute("aria-valuetext"), /^0\.\d s before the end$/);
  const last = await region.locator("img").first().getAttribute("src");
  await page.keyboard.press("ArrowLeft");
  assert.notEqual(await region.locator("img").first().getAttribute("src"), last);
  await region.getByRole("button", { name: "show depth" }).press("Enter");
  await region.getByRole("img", { name: /^depth image of front, / }).waitFor();
  await page.waitForFunction(() => document.querySelector("#crash img").naturalWidth > 100);
  assert.ok((await seen()) > 100);
  await region.getByRole("button", { name: "show colour" }).press("Enter");
  await checkBarriers(page, "the crash card");
  for (const size of ["laptop", "phone", "projector"]) {
    const [width, height] = SIZES[size];
    await page.setViewportSize({ width, height });
    await checkAccess(page, size);
    const map = await page.locator(".map").boundingBox();
    assert.ok(map.height >= 240, `${size}: the map beside the crash card is ${map.height} px high`);
    if (size === "phone") await region.scrollIntoViewIfNeeded();
    await shot(page, `${size}-crash`);
  }
  await page.locator("#theme").click();
  await shot(page, "projector-crash-other-theme");
  assert.deepEqual(page.faults, []);
  assert.equal(await demo.ended, 1, "a collision is no success");
  // The server is gone, and the card has its images: every one that is looked at.
  await region.getByRole("button", { name: "show depth" }).press("Enter");
  await slider.focus();
  await page.keyboard.press("Home");
  for (let before = ""; ; await page.keyboard.press("ArrowRight")) {
    const image = region.locator("img").first(), address = await image.getAttribute("src");
    if (address === before) break;
    assert.match(address, /depth/);
    await page.waitForFunction(() => document.querySelector("#crash img").naturalWidth > 100);
    before = address;
  }
  await page.context().close();
}

/** A lab whose page takes a login: wrong, right, cameras, scene, pairing, out again. */
async function lab(browser) {
  const scenes = path.join(scratch, "scenes"), keys = path.join(scratch, "keys");
  for (const [name, seed] of [["first", "1"], ["second", "2"]]) {
    const made = spawnSync(vizflyt, ["scene", "generate", "room", "--seed", seed, "-o", path.join(scenes, name)]);
    assert.equal(made.status, 0, `${made.stderr}`);
  }
  const set = spawnSync(vizflyt, ["password", "--keys", keys], { input: "four words for tests\n" });
  assert.equal(set.status, 0, `${set.stderr}`);
  const free = "127.0.0.1:0";
  const server = start("serve", path.join(scenes, "first"), "--scenes", scenes, "--login", "always", "--keys", keys,
    "--http", free, "--quic", free, "--vicon", free, "--renderer", "cpu", "--max-rate", "30", "--json", "--lifeline");
  const [, url] = await server.line(/"http":"([^"]+)"/);
  const page = await open(browser, url);
  await until(page, "link-text", /not logged in/);
  assert.ok(await page.locator("#reset").isHidden());
  await page.locator("#login").click();
  await shot(page, "login");
  await checkBarriers(page, "the login");
  await page.keyboard.type("not the password");
  await page.keyboard.press("Enter");
  await page.getByRole("alert").filter({ hasText: "this is not the password" }).waitFor();
  assert.equal(await page.evaluate(async () => (await fetch("/api/pairing")).status), 401);
  await page.keyboard.type("four words for tests");
  await page.keyboard.press("Enter");
  await until(page, "link-text", /live/);
  // The cookie is out of reach of scripts, and without its token nothing changes.
  assert.equal(await page.evaluate(() => document.cookie), "");
  const bare = await page.evaluate(async () => (await fetch("/api/pairing", { method: "POST", body: '{"right":"instructor"}' })).status);
  assert.equal(bare, 403);
  // A camera.
  await page.locator("#setup summary").click();
  await page.locator("#camera-form [name=width_px]").fill("200");
  await page.locator("#camera-form [name=sensor]").selectOption("imx219");
  await page.locator("#camera-form [name=depth_model]").selectOption("d435");
  await page.locator("#camera-form button[type=submit]").click();
  await until(page, "camera-status", /applied/);
  await until(page, "camera-name", /200 ×/);
  await checkBarriers(page, "a camera's settings");
  // The view in space: drawn, and turned by keys. Not in flight: without a card it takes the processor.
  const twin = page.waitForResponse((answer) => answer.url().includes("/api/splats/0"));
  await page.locator("#view-space").click();
  const canvas = page.locator("#space");
  await canvas.waitFor({ state: "visible" });
  let blank = 0;
  do {
    blank += 1;
    assert.ok(blank < 50, "the view in space stays blank");
    await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
  } while ((await canvas.screenshot()).length < 20_000);
  // The twin takes the place of the boxes; without a card its first part alone.
  assert.equal((await twin).status(), 200);
  await canvas.press("ArrowLeft");
  await shot(page, "laptop-space");
  for (const view of ["chase", "onboard"]) {
    await page.locator(`#view-${view}`).click();
    await page.locator(`#view-${view}[aria-pressed=true]`).waitFor();
    await shot(page, `laptop-${view}`);
  }
  await page.locator("#view-top").click();
  // Pairing; and the stop button works beside the panel, by mouse and by key.
  await page.getByRole("button", { name: "pair a computer" }).click();
  await page.getByRole("button", { name: "show a code" }).click();
  await page.waitForFunction(() => /^\d{3}.?\d{3}$/.test(document.querySelector(".pair-code").textContent));
  await shot(page, "pairing");
  await checkBarriers(page, "the pairing");
  await page.locator("#estop").click();
  await until(page, "announcement", /no runtime is connected/);
  // Escape closes the dialog first, and stops only then.
  await page.evaluate(() => (document.getElementById("announcement").textContent = ""));
  await page.keyboard.press("Escape");
  await page.locator("dialog[open]").waitFor({ state: "hidden" });
  assert.equal(await text(page, "announcement"), "");
  await page.keyboard.press("Escape");
  await until(page, "announcement", /no runtime is connected/);
  // Light and weather: a name at once, a sight with the button, and what has no field here is kept.
  await page.locator("#environment").click();
  await page.locator("#environment-choice").selectOption("night-fog");
  await page.waitForFunction(async () => (await (await fetch("/api/environment")).json()).name === "night-fog");
  assert.equal(await page.locator("#environment-sight").inputValue(), "12");
  await page.locator("#environment-sight").fill("30");
  await page.locator("dialog[open] button[type=submit]").click();
  await page.waitForFunction(async () => (await (await fetch("/api/environment")).json()).fog_visibility_m === 30);
  await page.locator("#environment-choice").selectOption("smoke");
  await page.waitForFunction(async () => (await (await fetch("/api/environment")).json()).name === "smoke");
  await page.locator("#environment-sight").fill("25");
  await page.locator("dialog[open] button[type=submit]").click();
  await page.waitForFunction(async () => {
    const { cloud, fog_visibility_m } = await (await fetch("/api/environment")).json();
    return fog_visibility_m === 25 && cloud.visibility_m === 12;
  });
  await shot(page, "environment");
  await checkBarriers(page, "light and weather");
  await page.locator("dialog[open]").getByRole("button", { name: "close" }).click();
  // Another scene: the page comes back by itself, still logged in.
  const before = await page.evaluate(async () => (await (await fetch("/api/scenes")).json()).now);
  assert.equal(before, "first");
  await page.locator("#scenes").click();
  await page.locator("#scene-choice").selectOption("second");
  await shot(page, "scenes");
  await checkBarriers(page, "the scenes");
  await page.locator("dialog[open] button[type=submit]").click();
  await page.waitForFunction(async () => {
    try {
      const answer = await fetch("/api/scenes");
      return answer.ok && (await answer.json()).now === "second";
    } catch {
      return false;
    }
  }, null, { polling: 250 });
  await until(page, "link-text", /live/);
  // Another window of the same login sees no more either, once it is logged out.
  const window = await page.context().newPage();
  await window.goto(url);
  await until(window, "link-text", /live/);
  await page.locator("#logout").click();
  await until(window, "link-text", /not logged in/);
  await until(page, "link-text", /not logged in/);
  assert.equal(await page.evaluate(async () => (await fetch("/api/pairing")).status), 401);
  assert.deepEqual(page.faults, []);
  await page.context().close();
  server.child.stdin.end();
  assert.equal(await server.ended, 0);
}

/** Runs a command of the program to its end; returns what it printed. */
function command(...args) {
  const { status, stdout, stderr } = spawnSync(vizflyt, args, { encoding: "utf8" });
  assert.equal(status, 0, `vizflyt ${args.join(" ")}: ${stderr}`);
  return stdout;
}

/** A team checks in on the page and flies; page and wall show its run, and then its signed grade, by themselves. */
async function leaderboard(browser) {
  const at = (name) => path.join(scratch, `board-${name}`);
  const database = at("runs.sqlite"), free = "127.0.0.1:0";
  command("scene", "generate", "race", "-o", at("race"));
  const [token] = command("leaderboard", "--database", database, "team", "add", "wasps").match(/^[0-9a-f]{32}$/m);
  const server = start("serve", at("race"), "--leaderboard", database, "--keys", at("server"), "--pair", "team:vizflyt",
    "--http", free, "--quic", free, "--vicon", free, "--renderer", "cpu", "--max-rate", "30", "--json", "--lifeline");
  const [ready] = await server.line(/^.*"ready":"server".*$/);
  const { http, quic, vicon, spawn: stand } = JSON.parse(ready);
  const [, code] = await server.line(/"pairing":{"code":"([0-9 ]+)"/);
  command("pair", quic, "--code", code, "--keys", at("jetson"));

  const page = await open(browser, http), wall = await open(browser, `${http}/wall`);
  const firstRow = (page, id) => page.locator(`#${id} tr`).first().innerText();
  const shows = (page, id, pattern) =>
    page.waitForFunction(([id, source]) => new RegExp(source).test(document.querySelector(`#${id} tr`)?.innerText), [id, pattern.source]);
  await shows(wall, "official", /nobody yet/);
  await page.locator("#leaderboard summary").click();
  await page.locator("#team-form [name=token]").fill("no token of any team");
  await page.locator("#team-form [name=attempt]").selectOption("official");
  await page.locator("#team-form button").click();
  await until(page, "team-status", /no team/);
  await page.locator("#team-form [name=token]").fill(token);
  await page.locator("#team-form button").click();
  await until(page, "checked-in", /wasps flies: official/);

  const vehicle = start("sim", "--vicon", vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", stand.join(), "--json");
  const [, mavlink] = await vehicle.line(/"mavlink":"([^"]+)"/);
  const fly = start("fly", "race", "--server", quic, "--keys", at("jetson"), "--mavlink", `udpout:${mavlink}`,
    "--seconds", "6", "--log-dir", at("flights"), "--json");
  const picture = wall.getByRole("region", { name: "who flies now" }).getByRole("figure");
  await picture.filter({ hasText: /wasps\s*official\s*\d\/\d\s*0:0\d\.\d/ }).waitFor();
  for (const canvas of ["map", "pictures canvas"]) await isPainted(wall, canvas);
  for (const size of ["phone", "projector", "laptop"]) {
    const [width, height] = SIZES[size];
    await wall.setViewportSize({ width, height });
    const over = await wall.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    assert.ok(over <= 0, `wall on ${size}: ${over} px too wide`);
    await shot(wall, `${size}-wall-flying`);
  }
  await checkBarriers(wall, "the wall while somebody flies");
  assert.equal(await fly.ended, 0);
  await picture.waitFor({ state: "detached" });
  // It has watched the run that leads: the next ones have it for a ghost.
  await until(wall, "ghost", /ghost: the best official run, wasps/);
  // Neither page is loaded again.
  for (const screen of [wall, page]) await shows(screen, "official", /^1\s+wasps\s+\d\/\d\s/);
  assert.match(await firstRow(wall, "practice"), /nobody yet/);
  assert.ok(await wall.locator("#graded-panel").isHidden(), "nobody has a grade yet");

  command("grade", "race", "--project", "p4", "--seeds", "1", "-o", at("grade.json"), "--keys", at("grader"));
  command("leaderboard", "--database", database, "add", at("grade.json"), "--team", "wasps", "--keys", at("grader"));
  await wall.locator("#graded-panel").waitFor();
  assert.match(await text(wall, "graded"), /graded: p4 ug, day[\s\S]*wasps/);
  const over = await wall.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  assert.ok(over <= 0, `wall: ${over} px too wide`);
  await checkBarriers(page, "the leaderboard");
  await checkBarriers(wall, "the wall");
  await shot(page, "laptop-leaderboard");
  await shot(wall, "wall");
  for (const screen of [page, wall]) {
    assert.deepEqual(screen.faults, []);
    await screen.context().close();
  }
  vehicle.child.kill();
  server.child.stdin.end();
  assert.equal(await server.ended, 0);
}

/** A lab day: checks go green by what is measured, red where the motion capture pauses; a queue, several vehicles, a report. */
async function labDay(browser) {
  const at = (name) => path.join(scratch, `day-${name}`), free = "127.0.0.1:0";
  command("scene", "generate", "room", "-o", at("room"));
  fs.appendFileSync(at("room/arena.toml"), '\n[[vehicles]]\nname = "wasp"\n[[vehicles]]\nname = "bee"\n');
  const server = start("serve", at("room"), "--leaderboard", "none", "--lab-day", at("kept.json"), "--keys", at("server"), "--print-page-keys",
    "--pair", "instructor", "--http", free, "--quic", free, "--vicon", free, "--renderer", "cpu", "--max-rate", "30", "--json", "--lifeline");
  const [ready] = await server.line(/^.*"ready":"server".*$/);
  const { http, quic, vicon, spawn: stand } = JSON.parse(ready);
  const [, code] = await server.line(/"pairing":{"code":"([0-9 ]+)"/);
  const [, teams] = await server.line(/"team of 'wasp'","link":"([^"]+)"/);
  command("pair", quic, "--code", code, "--keys", at("jetson"));
  const vehicle = start("sim", "--vicon", vicon, "--object", "wasp", "--airframe", "--radio", "--mavlink", "udpin:127.0.0.1:0", "--spawn", stand.join(), "--json");
  const [, mavlink] = await vehicle.line(/"mavlink":"([^"]+)"/);
  // What the autopilot has, before its runtime takes the link.
  const doctor = (...more) => spawnSync(vizflyt, ["doctor", "vehicle", "--mavlink", `udpout:${mavlink}`, "--arena", at("room/arena.toml"),
    ...more], { encoding: "utf8" });
  doctor("--apply");
  const { stdout, stderr } = doctor("--report", http, "--vehicle", "wasp");
  assert.match(stdout, /reported http\S+: noted for wasp/, stderr);

  const page = await open(browser, `${http}/lab`, { viewport: { width: 1280, height: 720 } });
  const check = (name, of = "wasp") => page.getByRole("region", { name: of ? `checks of ${of}` : "checks of the room" }).locator(`[data-check=${name}]`);
  const stands = (name, state, of) => check(name, of).and(page.locator(`[data-state=${state}]`)).waitFor();
  await stands("localization", "ok");
  await stands("network", "not_done");
  const fly = start("fly", "avoid", "--server", quic, "--vehicle", "wasp", "--keys", at("jetson"), "--mavlink", `udpout:${mavlink}`, "--wait", "--json");
  await page.getByRole("button", { name: "start wasp" }).waitFor();
  for (const name of ["network", "clocks", "battery"]) await stands(name, "ok");
  for (const name of ["parameters", "fence"]) await stands(name, "ok");
  // Whatever this computer's pace, it is measured.
  await page.waitForFunction(() => /images are \d+ ms old/.test(document.querySelector("[data-check=latency]").textContent));
  await page.waitForFunction(() => /polygons accepted/.test(document.querySelector("[data-check=fence]").textContent));
  await page.locator("#signer").fill("Ada Lovelace");
  await page.getByRole("button", { name: "sign: net closed" }).click();
  await stands("net", "ok", "");
  assert.match(await check("net", "").innerText(), /looked at by Ada Lovelace/);
  await page.getByRole("button", { name: "begin: axes of localization of wasp" }).click();
  await page.waitForFunction(() => /do: (put it on the floor|lift it)/.test(document.querySelector("[data-check=axes]").textContent));
  await page.getByRole("button", { name: "cancel: axes of localization of wasp" }).click();
  // The motion capture pauses: red, with what to do; and green when it is back.
  vehicle.child.kill("SIGSTOP");
  await page.waitForFunction(() => /no pose for[\s\S]*is the localization on/.test(document.querySelector("[data-check=localization]").textContent));
  await stands("localization", "failed");
  await shot(page, "lab-day-red");
  vehicle.child.kill("SIGCONT");
  await stands("localization", "ok");

  // A team books from its own address, and sees its place; the instructor calls.
  await page.locator("#book-form [name=team]").fill("cats");
  await page.locator("#book-form [name=vehicle]").selectOption("wasp");
  await page.locator("#book-form button").click();
  const team = await open(browser, teams, { viewport: { width: 390, height: 844 } });
  await team.goto(`${http}/lab`);
  await team.locator("#book-form [name=team]").fill("ants");
  await team.locator("#book-form button").click();
  await until(team, "lab-status", /place 2 for wasp/);
  await until(team, "lab-queue", /1cats[\s\S]*2ants/);
  assert.ok(await team.locator("#formation").isHidden() && await team.getByRole("button", { name: "sign: LiPo" }).isHidden());
  assert.equal(await team.getByRole("region", { name: "checks of bee" }).count(), 0);
  const call = (words) => page.getByRole("button", { name: `${words}, wasp` }).click();
  await call("call next");
  await until(team, "lab-queue", /nowcats/);
  await call("pass over");
  await call("call next");
  await until(team, "lab-queue", /nowants[\s\S]*1cats/);

  // The bee goes first: the wasp's start is refused with the reason.
  await page.locator("#formation-form [name=order]").fill("bee, wasp");
  await page.locator("#formation-form [name=separation]").fill("1.5");
  await page.locator("#formation-form button").click();
  await until(page, "lab-status", /order of take-off: bee, wasp; 1.5 m apart/);
  await page.getByRole("button", { name: "start wasp" }).click();
  await until(page, "lab-status", /'bee' goes before 'wasp' \(bee, wasp\) and is not up yet/);
  for (const [screen, size] of [[page, [1280, 720]], [page, [390, 844]], [team, [390, 844]]]) {
    await screen.setViewportSize({ width: size[0], height: size[1] });
    const over = await screen.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    assert.ok(over <= 0, `lab day: ${over} px too wide at ${size}`);
    const stop = await screen.locator("#estop").boundingBox();
    assert.ok(stop.x >= 0 && stop.x + stop.width <= size[0] && stop.y >= 0 && stop.y + stop.height <= size[1] && stop.height >= 44, JSON.stringify(stop));
    await shot(screen, `lab-day-${screen === team ? "team-" : ""}${size.join("x")}`);
  }
  // One STOP for all, by the keyboard: on the ground it is the trial of STOP.
  await page.keyboard.press("Escape");
  await stands("stop", "ok");
  assert.match(await check("stop").innerText(), /received by the runtime after \d+ ms, landing reported after \d+ ms, disarmed after \d+ ms/);
  await fly.ended;

  const paper = at("day.pdf");
  command("lab", "report", "--page", http, "--out", paper);
  const words = spawnSync("pdftotext", ["-layout", paper, "-"], { encoding: "utf8" });
  if (!words.error) {
    for (const expected of [/net closed\s+20\d\d-\d\d-\d\d \d\d:\d\d:\d\d UTC/, /looked at by Ada Lovelace/, /ants on wasp\s+booked/,
      /passed over 1 times/, /STOP tried/, /localization live failed/, /page 1 of \d/]) assert.match(words.stdout, expected);
    if (shots) spawnSync("pdftoppm", ["-r", "70", "-png", paper, path.join(shots, "lab-day-report")]);
  }
  const told = spawnSync(vizflyt, ["lab", "--page", http], { encoding: "utf8" });
  assert.equal(told.status, 1, "not all is done");
  assert.match(told.stdout, /page {5}http\S+\/lab\n[\s\S]*ok {7}the room: net closed[\s\S]*called {3}ants on wasp/);
  for (const screen of [page, team]) {
    assert.deepEqual(screen.faults, []);
    await screen.context().close();
  }
  vehicle.child.kill();
  server.child.stdin.end();
  assert.equal(await server.ended, 0);
}

/** A captured scene, tilted by 5 degrees and a tenth too small, is put into its room by clicks, and its place is written. */
async function align(browser) {
  const at = (name) => path.join(scratch, `align-${name}`);
  command("scene", "generate", "room", "--seed", "3", "-o", at("room"));
  const file = at("room/arena.toml");
  const place = 'scene = { file = "scene.ply", rotation = [0.0436, 0, 0, 0.99905], metres_per_unit = 0.9 }';
  // Without the course, which stays where it is when fence and start move along.
  const room = fs.readFileSync(file, "utf8").replace(/\[(goal|rules(\.\w+)?)\][^[]*(\[[\d -][^[]*)*/g, "");
  fs.writeFileSync(file, `# Captured by hand.\n${room.replace(/^scene = .*$/m, place)}`);
  const server = start("scene", "align", at("room"), "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/page\s+(http:\S+)/);
  const page = await open(browser, url);
  // The panel comes later than the first picture, as on a busy computer: what it asks for, it takes.
  await page.route("**/align.js", (route) => setTimeout(() => route.continue(), 1000));
  await page.reload();
  const press = (name) => page.getByRole("button", { name, exact: true }).click();
  /** Clicks into a picture that shows where the camera is now; returns the server's answer. */
  const pick = async (x, y) => {
    const answer = page.waitForResponse((response) => response.url().endsWith("/pick"));
    await page.mouse.click(x, y);
    const { p_scene, ...rest } = await (await answer).json().catch(() => ({ refused: true }));
    await page.waitForFunction(() => document.getElementById("hint").textContent !== "looking …");
    return { p_scene, ...rest };
  };
  await page.waitForFunction(() => document.body.dataset.pictures > 0);
  await until(page, "hint", /: 0 of at least 3/);
  const outside = await page.evaluate(async () => {
    const request = { p_m: [0.9, 0, 1.2], yaw_rad: 0, pitch_rad: 0, fov_deg: 75, width_px: 640, height_px: 400, depth: false };
    const answer = await fetch("/api/align/pick", { method: "POST", body: JSON.stringify({ request, px: [1000, 10] }) });
    return `${answer.status} ${await answer.text()}`;
  });
  assert.match(outside, /^422 the click lies outside/);
  for (const [x, y] of [[420, 780], [860, 780], [560, 640]]) assert.ok((await pick(x, y)).p_scene, `no floor at ${x}, ${y}`);
  await until(page, "verdict", /size not known yet/);
  assert.ok((await pick(840, 640)).p_scene);
  await until(page, "hint", /^4 points/);
  assert.ok(await page.locator("#save").isDisabled(), "without a length nothing is saved");
  await press("one end");
  const one = await pick(420, 780);
  const other = await pick(840, 640);
  // The scene's file is in metres: the truth that a tape would tell.
  const metres = Math.hypot(...one.p_scene.map((value, k) => value - other.p_scene[k]));
  await page.locator("#metres").fill(metres.toFixed(4));
  await page.locator("#metres").press("Tab");
  await until(page, "verdict", /GO/);
  assert.match(await text(page, "result"), /residual[\s\S]*cm rms[\s\S]*bound[\s\S]*within the fence/);
  await shot(page, "align");
  await checkBarriers(page, "the alignment");
  await page.getByLabel("fence to z in metres").fill("3.1");
  await page.getByLabel("fence to z in metres").press("Tab");
  await press("↶ 90°");
  await press("carry along");
  await until(page, "verdict", /GO/);
  const forced = await page.locator("#force").count();
  await page.locator(forced ? "#force" : "#save").click();
  await until(page, "saved", /written .*arena.toml/);
  const written = fs.readFileSync(file, "utf8");
  assert.ok(written.startsWith("# Captured by hand.\n"), written);
  assert.ok(Math.abs(+written.match(/metres_per_unit = ([\d.]+)/)[1] - 1) < 0.01, written);
  const [x, y, z, w] = written.match(/rotation = \[(.*?)\]/)[1].split(",").map(Number);
  // The file's z, where it points now.
  const up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
  assert.ok(up[2] > Math.cos((0.7 * Math.PI) / 180), `tilted still: ${up}`);
  assert.deepEqual(page.faults, []);
  await page.context().close();
  server.child.kill("SIGINT");
  await server.ended;
}

/** A scene is edited by hand: box and lasso, inverted, deleted, taken back, saved; its own file stays as it is. */
async function edit(browser) {
  const folder = path.join(scratch, "edited");
  command("scene", "generate", "room", "--seed", "3", "-o", folder);
  const scene = path.join(folder, "scene.ply"), original = fs.readFileSync(scene);
  const server = start("scene", "edit", folder, "--page", "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/^page\s+(http\S+)/);
  const page = await open(browser, url);
  const counts = async () => (await text(page, "edit-counts")).match(/[\d,]+/g).map((word) => +word.replaceAll(",", ""));
  /** Waits until the share of the picture that has about the colour of what is selected lies between two bounds; returns it. */
  const orange = async (least, most) => {
    const found = await page.waitForFunction(([least, most]) => {
      const canvas = document.getElementById("picture");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      let count = 0;
      for (let k = 0; k < data.length; k += 4) count += data[k] > data[k + 2] + 60 && data[k] > data[k + 1] + 25;
      const share = (count * 4) / data.length;
      return share >= least && share <= most && [share];
    }, [least, most], { polling: 200 });
    return (await found.jsonValue())[0];
  };
  /** Does something, and waits until it is counted. */
  const after = async (act, pattern) => {
    await act();
    await until(page, "edit-counts", pattern);
  };
  const drag = async (...corners) => {
    await page.mouse.move(...corners[0]);
    await page.mouse.down();
    for (const corner of corners.slice(1)) await page.mouse.move(...corner, { steps: 8 });
    await page.mouse.up();
  };
  await until(page, "edit-counts", /^0 of/);
  await isPainted(page, "picture");
  const [, all] = await counts();
  // Posters and boxes have it, too.
  const before = await orange(0, 0.1);
  await page.locator("#edit-box").click();
  await after(() => drag([420, 250], [900, 650]), /^[1-9]/);
  const [boxed] = await counts();
  assert.ok(boxed > 100 && boxed < all / 2, `${boxed} of ${all}`);
  // The box is 0.15 of the picture; the floor and the walls in it are seen as selected, and nothing else is.
  await orange(before + 0.08, before + 0.16);
  await shot(page, "edit-box");
  // Named as a part, it is found by a data set.
  await page.locator("#edit-naming summary").click();
  await page.locator("#edit-name").fill("corner");
  await after(() => page.locator("#edit-call").click(), /^0 of/);
  assert.match(await text(page, "edit-parts"), /^corner \(part\): [\d.]+ x [\d.]+ x [\d.]+ m$/);
  await shot(page, "edit-named");
  await checkBarriers(page, "the editor of scenes");
  const parts = fs.readFileSync(`${scene}.parts.toml`, "utf8");
  assert.match(parts, /name = "corner"\nclass = "part"\ncenter_m = \[/);
  await after(() => drag([420, 250], [900, 650]), new RegExp(`^${boxed.toLocaleString("en")} of`));
  await after(() => page.locator("#edit-invert").click(), new RegExp(`^${(all - boxed).toLocaleString("en")} of`));
  await after(() => page.locator("#edit-invert").click(), new RegExp(`^${boxed.toLocaleString("en")} of`));
  await after(() => page.locator("#edit-delete").click(), /^0 of/);
  assert.deepEqual(await counts(), [0, all - boxed]);
  await orange(0, before + 0.03);
  assert.ok(!fs.existsSync(`${scene}.edits.toml`), "nothing is written before it is saved");
  await page.locator("#edit-lasso").click();
  await after(() => drag([600, 300], [800, 320], [820, 500], [640, 520]), /^[1-9]/);
  const [lassoed] = await counts();
  await shot(page, "edit-lasso");
  await page.keyboard.press("Delete");
  await until(page, "edit-counts", new RegExp(`^0 of ${(all - boxed - lassoed).toLocaleString("en")} `));
  await page.locator("#edit-undo").click();
  await until(page, "edit-counts", new RegExp(`^0 of ${(all - boxed).toLocaleString("en")} `));
  assert.equal(await page.locator("#edit-steps li").count(), 1);
  await page.locator("#edit-save").click();
  await until(page, "edit-output", /^saved/);
  await shot(page, "edit-saved");
  assert.ok(fs.readFileSync(scene).equals(original), "the original has changed");
  assert.match(command("scene", "edit", folder, "--list"), new RegExp(`remove-lasso.*: ${boxed} splats away`));
  const again = path.join(folder, "again.ply");
  command("scene", "edit", folder, "--apply", "-o", again);
  assert.ok(fs.readFileSync(path.join(folder, "scene.edited.ply")).equals(fs.readFileSync(again)));
  // No other page edits.
  const foreign = await fetch(`${url}/api/edit`, { method: "POST", body: '"undo"', headers: { origin: "http://evil.example" } });
  assert.equal(foreign.status, 403);
  assert.deepEqual(page.faults, []);
  await page.context().close();
  server.child.kill("SIGTERM");
  assert.equal(await server.ended, 0);
}

/** A course is set up in a room by hand: a gate is put up, dragged, checked and written; comments stay, and it can be flown. */
async function course(browser) {
  const folder = path.join(scratch, "course");
  command("scene", "generate", "room", "--seed", "3", "-o", folder);
  const file = path.join(folder, "arena.toml");
  fs.writeFileSync(file, `# For Tuesday.\n${fs.readFileSync(file, "utf8")}`);
  const server = start("arena", "edit", folder, "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/^page\s+(http\S+)/);
  const page = await open(browser, url);
  const press = (name) => page.getByRole("button", { name, exact: true }).click();
  const value = async (label) => +(await page.getByLabel(label, { exact: true }).inputValue());
  await until(page, "course-verdict", /^can be flown: 0 gates/);
  assert.ok(await page.locator("#course-save").isDisabled(), "nothing has changed");
  await press("gate");
  await until(page, "course-verdict", /^can be flown: 1 gate, a way of [\d.]+ m · 0\.\d+ m of room/);
  // Its frame is in the picture: orange and white about the opening.
  await page.waitForFunction(() => {
    const canvas = document.getElementById("picture");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let k = 0; k < data.length; k += 4) count += data[k] > 170 && data[k + 1] < 110 && data[k + 2] < 60;
    return (count * 4) / data.length > 0.002;
  }, null, { polling: 200 });
  await shot(page, "course-gate");
  await checkBarriers(page, "the editor of courses");
  const [x, width] = [await value("middle x"), await value("width")];
  // From the eye's height the handle of the width is to the right of the middle; the picture is 75 degrees wide.
  const px = (metres) => (metres / (x - 0.9)) * (720 / Math.tan((37.5 * Math.PI) / 180));
  await page.mouse.move(720 + px(width / 2), 450);
  await page.mouse.down();
  await page.mouse.move(720 + px(width / 2 + 0.15), 450, { steps: 6 });
  await page.mouse.up();
  await until(page, "course-verdict", /^can be flown/);
  assert.equal(await value("width"), 1.5);
  await press("pillar");
  await until(page, "course-findings", /gate 1.*touches 'pillar 1'/);
  await until(page, "course-verdict", /^cannot be flown: 1 found/);
  await press("undo");
  await until(page, "course-verdict", /^can be flown/);
  await page.locator("#course-save").click();
  await until(page, "course-saved", /written .*arena.toml · models 1 new/);
  await shot(page, "course-saved");
  const written = fs.readFileSync(file, "utf8");
  assert.ok(written.startsWith("# For Tuesday.\n"), written);
  assert.match(written, /\[\[stages\]\]\nname = "gate 1"[\s\S]*width_m = 1.5[\s\S]*scene = "models\/gate-150x100-orange.ply"/);
  assert.match(command("arena", "check", folder), /can be flown; 1 stages/);
  const foreign = await fetch(`${url}/api/course`, { method: "POST", body: '"open"', headers: { origin: "http://evil.example" } });
  assert.equal(foreign.status, 403);
  assert.deepEqual(page.faults, []);
  await page.context().close();
  server.child.kill("SIGTERM");
  assert.equal(await server.ended, 0);
}

/** A stranger's tasks on a page: only by what is visible, named as it is shown; each task's seconds and clicks are printed. */
class Stranger {
  constructor() {
    this.tasks = [];
    this.clicks = 0;
  }

  async task(name, act) {
    const [began, clicks] = [Date.now(), this.clicks];
    await act();
    this.tasks.push(`${name} ${((Date.now() - began) / 1000).toFixed(1)} s, ${this.clicks - clicks} clicks`);
  }

  async press(page, name) {
    await page.getByRole("button", { name }).click();
    this.clicks += 1;
  }
}

/**
 * Somebody who has never seen the page watches two vehicles: understands it, chooses the other one, learns why that has
 * crashed, starts the first and stops it; and puts up a gate. Both are on the map and in space, at once.
 */
async function stranger(browser) {
  const at = (name) => path.join(scratch, `two-${name}`);
  const free = "127.0.0.1:0", plugin = path.join(path.dirname(vizflyt), "examples", "misbehave");
  command("scene", "generate", "race", "-o", at("race"));
  const file = at("race/arena.toml");
  const vehicle = (name, y_m) => `\n[[vehicles]]\nname = "${name}"\nspawn = { position_m = [0.9, ${y_m}, 0], yaw_deg = 0 }\n`;
  fs.appendFileSync(file, vehicle("wasp", 1.2) + vehicle("bee", 0));
  const server = start("serve", file, "--leaderboard", "none", "--keys", at("server"), "--pair", "instructor",
    "--http", free, "--quic", free, "--vicon", free, "--renderer", "cpu", "--max-rate", "30", "--json", "--lifeline");
  const [ready] = await server.line(/^.*"ready":"server".*$/);
  const { http, quic, vicon } = JSON.parse(ready);
  const [, code] = await server.line(/"pairing":{"code":"([0-9 ]+)"/);
  command("pair", quic, "--code", code, "--keys", at("jetson"));
  const flown = [];
  for (const [name, y_m, options, how] of [["wasp", 1.2, ["--wait"], ["hover"]], ["bee", 0, [], [INTO_THE_WALL]]]) {
    const sim = start("sim", "--object", name, "--vicon", vicon, "--mavlink", "udpin:127.0.0.1:0", "--spawn", `0.9,${y_m},0,0`, "--json");
    const [, mavlink] = await sim.line(/"mavlink":"([^"]+)"/);
    const fly = start("fly", plugin, "--vehicle", name, "--server", quic, "--keys", at("jetson"), "--mavlink", `udpout:${mavlink}`,
      "--log-dir", at("flights"), "--json", ...options, "--", ...how);
    flown.push([sim, fly]);
  }
  const somebody = new Stranger();
  let page;
  await somebody.task("understands what is shown:", async () => {
    page = await open(browser, http);
    const banner = page.getByRole("banner");
    await banner.getByText("race", { exact: true }).waitFor();
    await banner.getByText(/ready to start|preparing|no runtime/).waitFor();
    await page.getByRole("button", { name: /^STOP wasp/ }).waitFor();
  });
  const other = page.getByRole("button", { name: /^2 bee/ });
  await other.waitFor();
  for (const view of ["space", "top"]) {
    await page.getByRole("button", { name: view, exact: true }).click();
    await other.waitFor();
    await page.getByText(/^1 wasp/).waitFor();
    await shot(page, `laptop-two-${view}`);
  }
  await checkBarriers(page, "two vehicles");
  await page.getByRole("button", { name: /bee · landed/ }).waitFor();
  const way = page.waitForURL(/vehicle=bee/);
  await somebody.task("chooses the other vehicle:", async () => {
    await somebody.press(page, /^2 bee/);
    await way;
    await page.getByRole("button", { name: /^STOP bee/ }).waitFor();
  });
  await somebody.task("finds the cause of its crash:", async () => {
    const card = page.getByRole("region", { name: "Collision" });
    assert.match(await card.getByRole("paragraph").first().innerText(), /.{20}/);
  });
  // Back, by the number that stands there.
  await page.keyboard.press("1");
  await page.waitForURL(/vehicle=wasp/);
  await somebody.task("starts a vehicle:", async () => {
    await somebody.press(page, "start");
    await page.getByRole("banner").getByText(/taking off|holding|flying/).waitFor();
  });
  await page.getByRole("banner").getByText(/holding|flying/).waitFor();
  await somebody.task("stops it:", async () => {
    await somebody.press(page, /^STOP wasp/);
    await page.getByRole("alert").getByText("Stopped by hand").waitFor();
  });
  assert.deepEqual(page.faults, []);
  await page.context().close();
  for (const [sim, fly] of flown) {
    await fly.ended;
    sim.child.kill();
  }
  server.child.stdin.end();
  assert.equal(await server.ended, 0);

  command("scene", "generate", "room", "--seed", "3", "-o", at("room"));
  const editor = start("arena", "edit", at("room"), "--no-browser", "--renderer", "cpu");
  const [, url] = await editor.line(/^page\s+(http\S+)/);
  const drawing = await open(browser, url);
  await drawing.getByText(/can be flown: 0 gates/).waitFor();
  await somebody.task("places a gate:", async () => {
    await drawing.getByRole("button", { name: "gate", exact: true }).click();
    somebody.clicks += 1;
    await drawing.getByText(/can be flown: 1 gate/).waitFor();
  });
  await drawing.context().close();
  editor.child.kill("SIGTERM");
  await editor.ended;
  for (const task of somebody.tasks) console.log(`      ${task}`);
}

async function main() {
  if (shots) fs.mkdirSync(shots, { recursive: true });
  // Its sandbox wants rights that a container lacks; WebGL without a card is drawn in software.
  const args = ["--no-sandbox", "--enable-unsafe-swiftshader"];
  const browser = await chromium.launch({ executablePath: chromiumPath, args });
  let code = 0;
  const tests = [edit, course, lab, labDay, flight, crash, leaderboard, align, stranger];
  const wanted = tests.filter(({ name }) => !only || name === only);
  for (const test of wanted) {
    const began = Date.now();
    try {
      await test(browser);
      console.log(`ok    ${test.name} (${((Date.now() - began) / 1000).toFixed(0)} s)`);
    } catch (error) {
      code = 1;
      console.log(`FAIL  ${test.name}: ${error.stack}`);
      const page = browser.contexts().at(-1)?.pages()[0];
      if (page) {
        const shown = await page.evaluate(() => document.body.innerText);
        console.log(`      the page reports: ${page.faults}\n      it shows: ${shown.replaceAll(/\n+/g, " | ").slice(0, 1000)}`);
        await shot(page, `failed-${test.name}`);
      }
      // The next one has the machine for itself.
      for (const child of children.splice(0)) child.kill("SIGKILL");
    }
  }
  await browser.close();
  for (const child of children) child.kill("SIGKILL");
  fs.rmSync(scratch, { recursive: true, force: true });
  process.exit(code);
}

main();
