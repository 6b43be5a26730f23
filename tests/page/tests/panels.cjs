// Panels are closed, moved and stored, by keyboard, and reset; the cameras fill the page until escape.

const assert = require("node:assert/strict");
const { checkAccess, checkBarriers, isPainted, recordedTest, resize, text, until } = require("../harness.cjs");

recordedTest("panels", {
  of: "flight",
  real: (it) => it.raceDemo(),
  async body(it) {
    const page = await it.open(it.url);
    await it.event("waiting", { shown: () => until(page, "phase-text", /ready to start/) });
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
    await it.shot(page, "laptop-panels");
    // Escape closes the dialog, and stops no vehicle.
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
      await resize(page, size);
      await checkAccess(page, size);
      await it.shot(page, `${size}-cameras`);
    }
    await page.keyboard.press("Escape");
    await page.locator("#map").waitFor({ state: "visible" });
    assert.equal(await text(page, "announcement"), "");
    assert.deepEqual(it.orders, [], "nothing was ordered");
    await it.finish(page);
  },
});
