// The wall view: the standings, large, and who flies; asks every second, shows and can do nothing else.
import { ask, fill, fillGrades, flying } from "/standings.js";

const $ = (id) => document.getElementById(id);
const light = matchMedia("(prefers-color-scheme: light)");
const theme = () => (document.documentElement.dataset.theme = localStorage.getItem("theme") ?? (light.matches ? "light" : "dark"));
light.addEventListener("change", theme);
theme();

async function show() {
  try {
    const board = await ask();
    $("said").textContent = board ? "" : "no standings: are runs kept here, and are you logged in?";
    if (board) {
      $("course").textContent = board.course;
      document.title = `${board.course} – VizFlyt leaderboard`;
      fill($("official"), board.official);
      fill($("practice"), board.practice);
      fillGrades($("graded"), board.graded);
      $("graded-panel").hidden = !board.graded.length;
      $("flying").textContent = flying(board.vehicles);
    }
  } catch {
    $("said").textContent = "the server cannot be reached";
  }
  setTimeout(show, 1000);
}
show();
