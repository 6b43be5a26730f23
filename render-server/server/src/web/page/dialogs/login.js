// Login with the instructor's password, and logout.

import { makeFormDialog, makeLabel } from "../dialog.js";
import { $, make } from "../dom.js";
import { send, UNREACHABLE } from "../session.js";

const password = make("input", { type: "password", id: "password", autocomplete: "current-password", required: true });
const { dialog, form, status } = makeFormDialog("log in", "log in", "alert", makeLabel(password, "instructor's password"), password);

form.addEventListener("submit", async () => {
  status.textContent = "";
  try {
    // No token exists before login.
    const answer = await fetch("/api/login", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ password: password.value }),
    });
    if (answer.ok) {
      // Load everything again that was rejected before the login.
      location.reload();
      return;
    }
    status.textContent = await answer.text();
  } catch {
    status.textContent = UNREACHABLE;
  }
  password.value = "";
  password.focus();
});

$("login").addEventListener("click", () => {
  dialog.openFrom($("login"));
  password.focus();
});
$("logout").addEventListener("click", async () => {
  await send("POST", "/api/logout");
  location.reload();
});
