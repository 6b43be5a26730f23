// A watched flight is stored: it is available after a restart of the program; it is saved, loaded again, and replayed
// with itself as the ghost.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const { recordedTest, until } = require("../harness.cjs");

recordedTest("kept_flight", {
  of: "flight",
  real: (it) => it.raceDemo(),
  async body(it) {
    const page = await it.open(it.url);
    await it.event("waiting", { shown: () => until(page, "phase-text", /ready to start/) });
    await page.locator("#start").click();
    await it.event("flying", { shown: () => until(page, "clock", /^0:0[3-9]/) });
    await page.locator("#estop").click();
    await it.event("stopped", { shown: () => until(page, "outcome-title", /Stopped by hand|Collision|Left the geofence/) });
    await page.locator("#replay-save").waitFor();
    // The browser stores it a moment later: `flight_store.js`.
    await page.waitForFunction(() => new Promise((done, fail) => {
      const opening = indexedDB.open("vizflyt-flights");
      opening.onerror = () => fail(opening.error);
      opening.onsuccess = () => {
        const counting = opening.result.transaction("flights").objectStore("flights").count();
        counting.onsuccess = () => done(counting.result > 0);
        counting.onerror = () => fail(counting.error);
        opening.result.close();
      };
    }));
    await it.serverEnds(() => it.demo.ended);
    await it.serverReturns("waiting", (port) => it.raceDemo("--port", port));
    await page.reload();
    await until(page, "phase-text", /ready to start/);
    await until(page, "replay-flight", /choose a flight.*(Stopped by hand|Collision|Left the geofence)/);
    assert.ok(await page.locator("#replay-play").isDisabled(), "nothing has been watched yet");
    await page.locator("#replay-flight").selectOption({ index: 1 });
    await page.locator("#replay-at").fill("1");
    await until(page, "replay-time", /^0:01\.0 of \d:\d\d\.\d$/);
    const [saved] = await Promise.all([page.waitForEvent("download"), page.locator("#replay-save").click()]);
    assert.match(saved.suggestedFilename(), /^race-.*\.flight\.json$/);
    const file = it.at("again.json");
    await saved.saveAs(file);
    await page.locator("#replay-file").setInputFiles(file);
    await until(page, "replay-flight", /again\.json/);
    await page.locator("#replay-ghost").selectOption({ index: 2 });
    await page.locator("#replay-at").fill("1");
    await it.shot(page, "laptop-ghost");
    fs.writeFileSync(file, "{}");
    await page.locator("#replay-file").setInputFiles(file);
    await until(page, "outcome-text", /again\.json: the file is no flight of VizFlyt/);
    await it.finish(page);
  },
});
