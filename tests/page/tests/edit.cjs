// A scene is edited by hand: box and lasso, inverted, deleted, taken back, saved; its own file stays as it is.

const assert = require("node:assert/strict");
const fs = require("node:fs");
const path = require("node:path");
const { checkBarriers, isPainted, serverTest, text, until } = require("../harness.cjs");

serverTest("edit", async (it) => {
  const folder = it.at("edited");
  it.command("scene", "generate", "room", "--seed", "3", "-o", folder);
  const scene = path.join(folder, "scene.ply"), original = fs.readFileSync(scene);
  const server = it.start("scene", "edit", folder, "--page", "--no-browser", "--renderer", "cpu");
  const [, url] = await server.line(/^page\s+(http\S+)/);
  const page = await it.open(url);
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
  // The panel may come later than the first picture, and takes no outline before it has seen one itself.
  await page.evaluate(async () => {
    const { view } = await import("/view.js");
    view.listeners.push(() => (globalThis.isSeen = true));
    view.changed(false);
  });
  await page.waitForFunction(() => globalThis.isSeen);
  const [, all] = await counts();
  // Posters and boxes have it, too.
  const before = await orange(0, 0.1);
  await page.locator("#edit-box").click();
  await after(() => drag([420, 250], [900, 650]), /^[1-9]/);
  const [boxed] = await counts();
  assert.ok(boxed > 100 && boxed < all / 2, `${boxed} of ${all}`);
  // The box is 0.15 of the picture; the floor and the walls in it are seen as selected, and nothing else is.
  await orange(before + 0.08, before + 0.16);
  await it.shot(page, "edit-box");
  // Named as a part, it is found by a data set.
  await page.locator("#edit-naming summary").click();
  await page.locator("#edit-name").fill("corner");
  await after(() => page.locator("#edit-call").click(), /^0 of/);
  assert.match(await text(page, "edit-parts"), /^corner \(part\): [\d.]+ x [\d.]+ x [\d.]+ m$/);
  await it.shot(page, "edit-named");
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
  await it.shot(page, "edit-lasso");
  await page.keyboard.press("Delete");
  await until(page, "edit-counts", new RegExp(`^0 of ${(all - boxed - lassoed).toLocaleString("en")} `));
  await page.locator("#edit-undo").click();
  await until(page, "edit-counts", new RegExp(`^0 of ${(all - boxed).toLocaleString("en")} `));
  assert.equal(await page.locator("#edit-steps li").count(), 1);
  await page.locator("#edit-save").click();
  await until(page, "edit-output", /^saved/);
  await it.shot(page, "edit-saved");
  assert.ok(fs.readFileSync(scene).equals(original), "the original has changed");
  assert.match(it.command("scene", "edit", folder, "--list"), new RegExp(`remove-lasso.*: ${boxed} splats away`));
  const again = path.join(folder, "again.ply");
  it.command("scene", "edit", folder, "--apply", "-o", again);
  assert.ok(fs.readFileSync(path.join(folder, "scene.edited.ply")).equals(fs.readFileSync(again)));
  // No other page edits.
  const foreign = await fetch(`${url}/api/edit`, { method: "POST", body: '"undo"', headers: { origin: "http://evil.example" } });
  assert.equal(foreign.status, 403);
  await it.finish(page);
  server.child.kill("SIGTERM");
  assert.equal(await server.ended, 0);
});
