// A flight: it waits for its start, is watched, stopped by the keyboard, and replayed after the program has ended.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const { SIZES, checkAccess, checkBarriers, isPainted, recordedTest, resize, until } = require("../harness.cjs");

recordedTest("flight", {
  what: "a demo flight of the avoiding plugin, stopped by hand",
  without: /\/crash/,
  real: (it) => it.raceDemo("--report", it.at("report.json")),
  async body(it) {
    const page = await it.open(it.url);
    await it.event("waiting", {
      shown: async () => {
        await until(page, "phase-text", /ready to start/);
        for (const id of ["colour", "depth"]) await isPainted(page, id);
      },
    });
    // By keyboard only.
    await page.locator("#start").focus();
    await page.keyboard.press("Enter");
    await it.ordered("POST /api/vehicles/vizflyt/start");
    await it.event("flying", {
      shown: async () => {
        await until(page, "phase-text", /flying|holding/);
        for (const id of ["colour", "depth"]) await isPainted(page, id);
        await until(page, "clock", /^0:0[3-9]/);
        await until(page, "poses", /^\d+$/);
        await until(page, "battery", /^\d/);
      },
    });
    await it.shot(page, "laptop-flying");
    // In a text field, space types a space; escape stops from anywhere.
    await page.keyboard.press("Escape");
    await it.ordered("POST /api/vehicles/vizflyt/estop");
    await until(page, "announcement", /lands/);
    await it.event("stopped", { shown: () => until(page, "outcome-title", /Stopped by hand|Collision|Left the geofence/) });
    await it.shot(page, "laptop-stopped");
    await checkBarriers(page, "the page after a stop");
    // The flight can be replayed after the program has ended.
    await it.serverEnds(async () => {
      assert.equal(await it.demo.ended, 1, "a stopped flight is not a success");
      assert.equal(JSON.parse(fs.readFileSync(it.at("report.json"))).outcome === "finished", false);
    });
    await page.locator("#replay-at").fill("1");
    await until(page, "replay-time", /^0:01\.0 of \d:\d\d\.\d$/);
    // The button shows "pause" for the remaining two seconds, which a busy browser may miss.
    await page.evaluate(() => {
      const play = document.getElementById("replay-play");
      new MutationObserver(() => (globalThis.hasPlayed ||= play.textContent === "pause")).observe(play, { childList: true });
    });
    await page.locator("#replay-play").click();
    await page.waitForFunction(() => globalThis.hasPlayed);
    await page.waitForFunction(() => Number(document.getElementById("replay-at").value) > 1.2);
    for (const size of Object.keys(SIZES)) {
      await resize(page, size);
      await checkAccess(page, size);
      await it.shot(page, `${size}-replay`);
    }
    await page.locator("#replay-now").click();
    await page.locator("#replay-now").waitFor({ state: "hidden" });
    await it.finish(page);
  },
});
