// A server whose page requires a login: wrong password, right password, and logout in every window.

const assert = require("node:assert/strict");
const { spawnSync } = require("node:child_process");
const { checkBarriers, serverTest, text, until } = require("../harness.cjs");

const PASSWORD = "four words for tests";

/** Starts a server that always requires the password, with two scenes. */
async function guarded(it) {
  for (const [name, seed] of [["first", "1"], ["second", "2"]]) it.command("scene", "generate", "room", "--seed", seed, "-o", it.at(`scenes/${name}`));
  const set = spawnSync(it.program.vizflyt, ["password", "--keys", it.at("keys")], { input: `${PASSWORD}\n` });
  assert.equal(set.status, 0, `${set.stderr}`);
  return it.serve(it.at("scenes/first"), "--scenes", it.at("scenes"), "--login", "always", "--keys", it.at("keys"));
}

/** Opens the page without a login, with the login dialog. */
async function openLogin(it, url) {
  const page = await it.open(url);
  await until(page, "link-text", /not logged in/);
  assert.ok(await page.locator("#reset").isHidden());
  await page.locator("#login").click();
  return page;
}

/** Executes an action that reloads the page, and waits for the reload: until then the old page may still connect. */
const reloaded = (page, act) => Promise.all([page.waitForEvent("load"), act()]);

async function logIn(page) {
  await reloaded(page, async () => {
    await page.keyboard.type(PASSWORD);
    await page.keyboard.press("Enter");
  });
  await until(page, "link-text", /live/);
}

const pairingStatus = (page) => page.evaluate(async () => (await fetch("/api/pairing")).status);

serverTest("login", async (it) => {
  const server = await guarded(it);
  const page = await openLogin(it, server.http);
  await it.shot(page, "login");
  await checkBarriers(page, "the login");
  await page.keyboard.type("not the password");
  await page.keyboard.press("Enter");
  await page.getByRole("alert").filter({ hasText: "this is not the password" }).waitFor();
  assert.equal(await pairingStatus(page), 401);
  await logIn(page);
  // Scripts cannot read the cookie, and requests without its token change nothing.
  assert.equal(await page.evaluate(() => document.cookie), "");
  const bare = await page.evaluate(async () => (await fetch("/api/pairing", { method: "POST", body: '{"right":"instructor"}' })).status);
  assert.equal(bare, 403);
  // Another window of the same login is logged out, too.
  const window = await page.context().newPage();
  it.watch(window, server.http);
  await window.goto(server.http);
  await until(window, "link-text", /live/);
  await reloaded(page, () => page.locator("#logout").click());
  await until(window, "link-text", /not logged in/);
  await until(page, "link-text", /not logged in/);
  assert.equal(await pairingStatus(page), 401);
  assert.deepEqual(window.faults, []);
  await it.finish(page);
  await server.end();
});

serverTest("pairing", async (it) => {
  const server = await guarded(it);
  const page = await openLogin(it, server.http);
  await logIn(page);
  // The stop button works while the dialog is open, by mouse and by key.
  await page.locator("#setup summary").click();
  await page.getByRole("button", { name: "pair a computer" }).click();
  await page.getByRole("button", { name: "show a code" }).click();
  await page.waitForFunction(() => /^\d{3}.?\d{3}$/.test(document.querySelector(".pair-code").textContent));
  await it.shot(page, "pairing");
  await checkBarriers(page, "the pairing");
  await page.locator("#estop").click();
  await until(page, "announcement", /no runtime is connected/);
  // Escape closes the dialog first, and stops only then.
  const clear = () => page.evaluate(() => (document.getElementById("announcement").textContent = ""));
  await clear();
  await page.keyboard.press("Escape");
  await page.locator("dialog[open]").waitFor({ state: "hidden" });
  assert.equal(await text(page, "announcement"), "");
  await page.keyboard.press("Escape");
  await until(page, "announcement", /no runtime is connected/);
  // The second escape stops at once, although a dialog's close event comes later.
  await page.locator("#setup summary").click();
  await page.getByRole("button", { name: "pair a computer" }).click();
  await page.locator("dialog[open]").waitFor();
  await clear();
  await page.evaluate(() => {
    for (let times = 0; times < 2; times++) document.dispatchEvent(new KeyboardEvent("keydown", { code: "Escape", bubbles: true, cancelable: true }));
  });
  await until(page, "announcement", /no runtime is connected/);
  await it.finish(page);
  await server.end();
});

serverTest("scenes", async (it) => {
  const server = await guarded(it);
  const page = await openLogin(it, server.http);
  await logIn(page);
  // Another scene: the page reconnects, still logged in.
  const before = await page.evaluate(async () => (await (await fetch("/api/scenes")).json()).now);
  assert.equal(before, "first");
  await page.locator("#scenes").click();
  await page.locator("#scene-choice").selectOption("second");
  await it.shot(page, "scenes");
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
  await it.finish(page);
  await server.end();
});
