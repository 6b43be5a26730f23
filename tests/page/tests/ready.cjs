// The page before a flight, on a laptop, a phone and a projector; also the cost of opening it.

const assert = require("node:assert/strict");
const { checkAccess, checkBarriers, isPainted, recordedTest, resize, until } = require("../harness.cjs");

recordedTest("ready", {
  of: "flight",
  real: (it) => it.raceDemo(),
  async body(it) {
    const page = await it.open(it.url);
    await it.event("waiting", { shown: () => until(page, "phase-text", /ready to start/) });
    assert.ok(await page.locator("#land").isHidden(), "nothing to land yet");
    await isPainted(page, "map");
    // Without a graphics card, the top view is the default.
    await page.locator("#view-top[aria-pressed=true]").waitFor();
    assert.ok((await page.locator("#stages li").count()) > 0, "stage lights");
    assert.equal(await page.locator("#stages [aria-current]").count(), 1);
    await checkAccess(page, "laptop");
    await page.locator("#theme").click();
    await it.shot(page, "laptop-other-theme");
    await page.locator("#theme").click();
    await checkBarriers(page, "the page before a flight");
    for (const size of ["phone", "projector", "laptop"]) {
      await resize(page, size);
      await checkAccess(page, size);
      await it.shot(page, `${size}-ready`);
    }
    await it.finish(page);
  },
});

/** Largest file, which is loaded last. */
const LAST = "/three.core.min.js";

recordedTest("load", {
  of: "flight",
  real: (it) => it.raceDemo(),
  async body(it) {
    const other = await it.open(it.url);
    await it.event("waiting", { shown: () => until(other, "phase-text", /ready to start/) });
    const page = await other.context().newPage();
    it.watch(page, it.url);
    const wire = await page.context().newCDPSession(page);
    await wire.send("Network.enable");
    let bytes = 0, lastId = "";
    wire.on("Network.responseReceived", ({ requestId, response }) => {
      if (response.url.endsWith(LAST)) lastId = requestId;
    });
    const counted = new Promise((done) => wire.on("Network.loadingFinished", ({ requestId, encodedDataLength }) => {
      bytes += encodedDataLength;
      if (requestId === lastId) done();
    }));
    const began = Date.now();
    const last = page.waitForResponse((answer) => answer.url().endsWith(LAST));
    await page.goto(it.url);
    await isPainted(page, "colour");
    const first_s = (Date.now() - began) / 1000;
    assert.equal(await (await last).finished(), null);
    await counted;
    console.log(`first picture after ${first_s.toFixed(2)} s; ${(bytes / 1e6).toFixed(2)} MB over the wire`);
    assert.ok(bytes > 1e5 && bytes <= 3e6, `${bytes} bytes`);
    assert.deepEqual(page.faults, []);
    await it.finish(other);
  },
});
