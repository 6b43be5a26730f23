// A scene is edited by hand: box and lasso, invert, delete, undo, save; the scene's file is not changed.

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
  /** Waits until the share of the highlight's colour in the image is between two bounds; returns it. */
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
  /** Executes an action, and waits until it is counted. */
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
  // The panel may load after the first image, and accepts no outline before it has received one.
  await page.evaluate(async () => {
    const { view } = await import("/view.js");
    view.listeners.push(() => (globalThis.isSeen = true));
    view.changed(false);
  });
  await page.waitForFunction(() => globalThis.isSeen);
  const [, all] = await counts();
  // Posters and boxes have the colour, too.
  const before = await orange(0, 0.1);
  await page.locator("#edit-box").click();
  await after(() => drag([420, 250], [900, 650]), /^[1-9]/);
  const [boxed] = await counts();
  assert.ok(boxed > 100 && boxed < all / 2, `${boxed} of ${all}`);
  // The box is 0.15 of the image; only floor and walls inside are highlighted.
  await orange(before + 0.08, before + 0.16);
  await it.shot(page, "edit-box");
  // A data set finds the named part.
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
  assert.match(it.command("scene", "edit", folder, "--list"), new RegExp(`remove-lasso.*: ${boxed} splats removed`));
  const again = path.join(folder, "again.ply");
  it.command("scene", "edit", folder, "--apply", "-o", again);
  assert.ok(fs.readFileSync(path.join(folder, "scene.edited.ply")).equals(fs.readFileSync(again)));
  // Pages of other sites cannot edit.
  const foreign = await fetch(`${url}/api/edit`, { method: "POST", body: '"undo"', headers: { origin: "http://evil.example" } });
  assert.equal(foreign.status, 403);
  await it.finish(page);
  server.child.kill("SIGTERM");
  assert.equal(await server.ended, 0);
});
