// A flight straight into a wall: its crash card appears automatically, and is operated by keyboard only.

const assert = require("node:assert/strict");
const { INTO_THE_WALL, checkAccess, checkBarriers, recordedTest, resize, text, until } = require("../harness.cjs");

recordedTest("crash_card", {
  what: "a demo flight straight into the middle of a wall",
  without: /api\/map/,
  // Few images, to keep the recording small.
  real: (it) => it.raceDemo("--max-rate", "6", "--plugin", it.plugin("into-the-wall", INTO_THE_WALL)),
  async body(it) {
    const page = await it.open(it.url);
    const loaded = new Set();
    page.on("requestfinished", (request) => /\/crash\/.*\/(colour|depth)\/\d+$/.test(request.url()) && loaded.add(request.url()));
    await it.event("waiting", { shown: () => until(page, "phase-text", /ready to start/) });
    const region = page.locator("#crash");
    assert.ok(await region.isHidden(), "nothing has crashed yet");
    await page.locator("#start").click();
    await it.ordered("POST /api/vehicles/vizflyt/start");
    const seen = () => page.waitForFunction(() => document.querySelector("#crash img")?.naturalWidth > 100);
    await it.event("crashed", {
      shown: async () => {
        await until(page, "outcome-title", /Collision/);
        await page.getByRole("region", { name: "Collision" }).waitFor();
        await seen();
      },
    });
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
    // It plays automatically until it is paused; then image by image.
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
    await seen();
    await region.getByRole("button", { name: "show colour" }).press("Enter");
    await checkBarriers(page, "the crash card");
    for (const size of ["laptop", "phone", "projector"]) {
      await resize(page, size);
      await checkAccess(page, size);
      const map = await page.locator(".map").boundingBox();
      assert.ok(map.height >= 240, `${size}: the map beside the crash card is ${map.height} px high`);
      if (size === "phone") await region.scrollIntoViewIfNeeded();
      await it.shot(page, `${size}-crash`);
    }
    await page.locator("#theme").click();
    await it.shot(page, "projector-crash-other-theme");
    assert.deepEqual(page.faults, []);
    // The page has loaded all images.
    const total = images.reduce((sum, { before_s }) => sum + 2 * before_s.length, 0);
    while (loaded.size < total) await page.waitForEvent("requestfinished");
    await it.serverEnds(async () => assert.equal(await it.demo.ended, 1, "a collision is not a success"));
    // The server has ended, and the card still shows every image.
    await region.getByRole("button", { name: "show depth" }).press("Enter");
    await slider.focus();
    await page.keyboard.press("Home");
    let looked = 0;
    for (let before = ""; ; await page.keyboard.press("ArrowRight"), looked++) {
      const address = await region.locator("img").first().getAttribute("src");
      if (address === before) break;
      assert.match(address, /depth/);
      await seen();
      before = address;
    }
    assert.equal(looked, count, "images looked at");
    await page.context().close();
  },
});
