// Shared by the tests of the page: a browser, pages that record their faults, a program or a recorded server, and
// checks of every page.
//
//   node all.cjs [--shots DIR] [--real | --record] [--only NAME]... VIZFLYT
//   node tests/NAME.cjs [...as above]

const assert = require("node:assert/strict");
const fs = require("node:fs");
const os = require("node:os");
const path = require("node:path");
const { test, after } = require("node:test");
const { parseArgs } = require("node:util");
const { chromium } = require("playwright-core");
const { PATIENCE_MS, Program } = require("./program.cjs");
const { Recorder } = require("./record.cjs");
const { Replay, VIEWER } = require("./replay.cjs");

const { values: options, positionals: [vizflyt] } = parseArgs({
  allowPositionals: true,
  options: {
    shots: { type: "string" }, only: { type: "string", multiple: true, default: [] },
    real: { type: "boolean", default: false }, record: { type: "boolean", default: false },
  },
});
/** Timeout of a page that does not answer after a failure. [ms] */
const EXPLAIN_MS = 10_000;
/** Script that finds accessibility barriers; run in the page. */
const axe = fs.readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const executablePath = process.env.CHROMIUM ?? ["/usr/bin/chromium", "/usr/bin/chromium-browser"].find(fs.existsSync);
const SIZES = { laptop: [1440, 900], phone: [390, 844], projector: [1920, 1080] };
/** Chromium's sandbox needs rights that a container lacks; WebGL without a graphics card is drawn in software. */
const CHROMIUM_ARGS = ["--no-sandbox", "--enable-unsafe-swiftshader"];
/** Arguments of `misbehave` that fly past the race's gap into the middle of the wall: straight on, it would miss, or hit the edge of a post. */
const INTO_THE_WALL = "world:1:-0.16";

if (options.shots) fs.mkdirSync(options.shots, { recursive: true });

/** Browser that all tests share. */
let shared = null;
const launch = (...args) => chromium.launch({ executablePath, args: args.length ? args : CHROMIUM_ARGS, timeout: PATIENCE_MS });
after(async () => (await shared)?.close());

/** One test with its folder, processes and pages. */
class Fixture {
  constructor(name) {
    this.name = name;
    this.scratch = fs.mkdtempSync(path.join(os.tmpdir(), `vizflyt-page-${name}-`));
    // A plugin runs as the user nobody, and can read only its own folder.
    fs.chmodSync(this.scratch, 0o755);
    this.program = new Program(vizflyt);
    this.pages = [];
    this.browsers = [];
    /** Requests of the pages that change something, in order. */
    this.orders = [];
    this.waiting = new Set();
    this.recorder = null;
  }

  at(name) {
    return path.join(this.scratch, name);
  }

  start(...args) {
    return this.program.start(...args);
  }

  command(...args) {
    return this.program.command(...args);
  }

  /** Starts a server whose listeners use free ports of this computer; `more` are additional options. */
  async serve(place, ...more) {
    const free = "127.0.0.1:0";
    const server = this.start("serve", place, "--http", free, "--quic", free, "--vicon", free, "--renderer", "cpu",
      "--max-rate", "30", "--json", "--lifeline", ...more);
    const [ready] = await server.line(/^.*"ready":"server".*$/);
    const end = async () => {
      server.child.stdin.end();
      assert.equal(await server.ended, 0);
    };
    return { ...server, ...JSON.parse(ready), end };
  }

  /** Starts a demo that waits for its start, without a page of its own, at most at the page's frame rate. */
  async startDemo(...args) {
    const rate = args.includes("--max-rate") ? [] : ["--max-rate", "30"];
    const demo = this.start("demo", "--headless", "--wait", "--log-dir", this.scratch, ...rate, ...args);
    const [, url] = await demo.line(/page\s+(http:\S+)/);
    return { ...demo, url };
  }

  /** Generates the race with cameras whose images are small enough for a recording; returns its arena's file. */
  smallRace(name) {
    this.command("scene", "generate", "race", "--force", "-o", this.at(name));
    const file = path.join(this.at(name), "arena.toml");
    const small = fs.readFileSync(file, "utf8").replace(/width_px = 320\nheight_px = 240/, "width_px = 120\nheight_px = 90");
    fs.writeFileSync(file, small);
    return file;
  }

  /** Starts a demo of that race; returns its page's address. */
  async raceDemo(...args) {
    this.demo = await this.startDemo("--scene", this.smallRace("race"), ...args);
    return this.demo.url;
  }

  /** Creates a plugin that is `misbehave` with these arguments; returns its path. */
  plugin(name, ...args) {
    const { misbehave } = this.program;
    assert.ok(fs.existsSync(misbehave), `no ${misbehave}: cargo build --examples`);
    const folder = this.at("plugins");
    fs.mkdirSync(folder, { recursive: true, mode: 0o755 });
    fs.copyFileSync(misbehave, path.join(folder, "misbehave"));
    const script = path.join(folder, name);
    fs.writeFileSync(script, `#!/bin/sh\nexec "$(dirname "$0")/misbehave" ${args.join(" ")} "$@"\n`, { mode: 0o755 });
    return script;
  }

  /**
   * Opens a page in a separate context, in the shared browser or in `browser`; it records its faults. A `viewer` is a page to
   * which the server sends less.
   */
  async open(url, { browser, viewer, ...more } = {}) {
    shared ??= launch();
    const context = await (browser ?? (await shared)).newContext({ viewport: { width: 1440, height: 900 }, ...this.asViewer(viewer), ...more });
    // A busy computer needs longer to open a page.
    context.setDefaultTimeout(PATIENCE_MS);
    const page = await context.newPage();
    this.watch(page, url, viewer);
    await page.goto(url);
    return page;
  }

  /** Starts another browser, with other arguments. */
  async launch(...args) {
    const browser = await launch(...args);
    this.browsers.push(browser);
    return browser;
  }

  asViewer() {
    return {};
  }

  watch(page, url, viewer) {
    page.setDefaultTimeout(PATIENCE_MS);
    page.faults = [];
    this.pages.push(page);
    page.on("pageerror", (error) => page.faults.push(`error: ${error.message}`));
    page.on("request", (request) => {
      const to = new URL(request.url());
      // The page must work without Internet: it may not contact other hosts.
      if (!["blob:", "data:"].includes(to.protocol) && to.host !== new URL(url).host) page.faults.push(`asks ${to.host}`);
      if (request.method() === "GET") return;
      this.orders.push({ order: `${request.method()} ${to.pathname}`, body: request.postData() && request.postDataJSON() });
      for (const look of this.waiting) look();
    });
    this.recorder?.watch(page, viewer);
  }

  /** Waits until a page has sent one more of an order; returns its body. */
  ordered(order) {
    return new Promise((done, fail) => {
      const timer = setTimeout(() => fail(new Error(`no page has sent ${order}, but ${JSON.stringify(this.orders)}`)), PATIENCE_MS);
      const look = () => {
        const at = this.orders.findIndex((one) => one.order === order && !one.isSeen);
        if (at < 0) return;
        this.orders[at].isSeen = true;
        clearTimeout(timer);
        this.waiting.delete(look);
        done(this.orders[at].body);
      };
      this.waiting.add(look);
      look();
    });
  }

  async shot(page, name) {
    if (options.shots) await page.screenshot({ path: path.join(options.shots, `${name}.png`) });
  }

  /** Closes pages and checks that they have no faults. */
  async finish(...pages) {
    for (const page of pages) {
      assert.deepEqual(page.faults, []);
      await page.context().close();
    }
  }

  /** Prints and returns the text and the faults of all pages, which show the cause of a failure. */
  async explain() {
    const lines = [];
    for (const page of this.pages.filter((page) => !page.isClosed())) {
      const shown = await page.locator("body").innerText({ timeout: EXPLAIN_MS }).catch(String);
      const explained = [`${page.url()} reports: ${page.faults}`, `  it shows: ${shown.replaceAll(/\n+/g, " | ").slice(0, 1000)}`];
      console.log(explained.join("\n"));
      lines.push(...explained);
      await this.shot(page, `failed-${this.name}`).catch((error) => console.log(`no picture: ${error.message}`));
    }
    return lines;
  }

  async close() {
    for (const page of this.pages) if (!page.isClosed()) await page.context().close();
    for (const browser of this.browsers) await browser.close();
    await this.program.kill();
    // Plugins survive their killed program for a moment, and may still write here.
    fs.rmSync(this.scratch, { recursive: true, force: true, maxRetries: 10, retryDelay: 100 });
  }
}

/**
 * A test against a recorded server, or, with --real and --record, against the real one: `real` starts it. Both follow
 * the same sequence; in the recording, events are marks.
 */
class RecordedFixture extends Fixture {
  constructor(name, { of = name, what, without }) {
    super(name);
    this.recording = of;
    this.isReal = options.real || options.record;
    if (options.record) this.recorder = new Recorder(name, what, without);
    this.replay = null;
  }

  async begin(real) {
    if (this.isReal) this.url = await real(this);
    else {
      this.replay = await Replay.start(this.recording);
      this.url = this.replay.url;
    }
  }

  asViewer(viewer) {
    return this.replay && viewer ? { extraHTTPHeaders: { [VIEWER]: viewer } } : {};
  }

  /** Advances to the moment `name`; with the real server, `really` causes it. Then waits until it is `shown`. */
  async event(name, { really = () => {}, shown = () => {} }) {
    if (this.replay) await this.replay.to(name);
    else await really();
    await shown();
    this.recorder?.mark(name);
  }

  /** Executes a step that only a real server needs; returns its result, or nothing. */
  async really(act) {
    return this.isReal ? act() : undefined;
  }

  /** Waits for the end of the server. */
  async serverEnds(really) {
    this.recorder?.end();
    await (this.replay ? this.replay.end() : really());
  }

  /** Restarts the server at the same port, at the moment `mark`. */
  async serverReturns(mark, really) {
    if (!this.replay) return really(new URL(this.url).port);
    this.replay = await Replay.start(this.recording, { port: Number(new URL(this.url).port), mark });
  }

  async close() {
    await super.close();
    if (this.replay?.server.listening) await this.replay.end();
  }
}

const isWanted = (name) => !options.only.length || options.only.includes(name);

async function run(fixture, body) {
  let failure = null;
  try {
    await body(fixture);
  } catch (error) {
    failure = error;
    // The reporter lists it with the error.
    failure.explanation = await fixture.explain();
  }
  // An error on closing must not hide the first one.
  await fixture.close().catch((error) => (failure ??= error));
  if (failure) throw failure;
}

/** Defines a test against the real program. */
function serverTest(name, body) {
  if (!isWanted(name) || options.record) return;
  test(name, () => {
    assert.ok(vizflyt, "this test starts the program: give its path");
    return run(new Fixture(name), body);
  });
}

/**
 * Defines a test against recorded messages; `real` starts the program that they are recorded from, and returns the
 * page's address. `of` names another test's recording, if that one reaches the same moments. Answers at addresses that
 * match `without` are not recorded.
 */
function recordedTest(name, { real, body, ...about }) {
  if (!isWanted(name) || (options.record && about.of)) return;
  test(name, () =>
    run(new RecordedFixture(name, about), async (fixture) => {
      await fixture.begin(real);
      await body(fixture);
      assert.deepEqual(fixture.replay?.unknown ?? [], [], "requests without a recorded answer: record again");
      await fixture.recorder?.write();
    }));
}

// ---- checks of every page ----

const text = (page, id) => page.locator(`#${id}`).innerText();
/** Waits until an element's text matches; the error names both. */
const until = (page, id, pattern) =>
  page.waitForFunction(([id, source]) => new RegExp(source).test(document.getElementById(id)?.textContent ?? ""), [id, pattern.source])
    .catch((error) => {
      throw new Error(`#${id} does not show ${pattern}: ${error.message}`, { cause: error });
    });

/** Checks that every control has a label, and that the stop button is visible. */
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
  await checkWidth(page, size);
}

/** Checks that nothing requires horizontal scrolling. */
async function checkWidth(page, what) {
  const over = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  assert.ok(over <= 0, `${what}: ${over} px too wide`);
}

async function resize(page, size) {
  const [width, height] = SIZES[size];
  await page.setViewportSize({ width, height });
}

/** Checks with axe that open parts have no accessibility barriers, in the dark and in the light theme. */
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

/** Waits until a canvas shows an image instead of one colour; the error names the canvas. */
const isPainted = (page, id) =>
  page.waitForFunction((id) => {
    const canvas = document.querySelector(`#${id}`);
    if (!canvas?.width) return false;
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let k = 0; k < data.length; k += 404) seen.add((data[k] << 16) | (data[k + 1] << 8) | data[k + 2]);
    return seen.size > 20;
  }, id).catch((error) => {
    throw new Error(`#${id} shows no picture: ${error.message}`, { cause: error });
  });

module.exports = {
  INTO_THE_WALL, PATIENCE_MS, SIZES, checkAccess, checkBarriers, checkWidth, isPainted, options, recordedTest, resize, serverTest, text, until,
};
