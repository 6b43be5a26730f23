// The panels of the page: every one is in this table, and nowhere else. A panel makes its own element; the page puts it
// in a column, and calls those of the functions below that it has.

import { arenaView } from "./panels/arena_view.js";
import { cameraImages } from "./panels/camera_images.js";
import { cameraSettings } from "./panels/camera_settings.js";
import { crashCard } from "./panels/crash_card.js";
import { events } from "./panels/events.js";
import { figures } from "./panels/figures.js";
import { leaderboard } from "./panels/leaderboard.js";
import { sensors } from "./panels/sensors.js";
import { timing } from "./panels/timing.js";

/**
 * What receives the server's messages.
 * @typedef {object} Part
 * @property {(arena: import("./messages").Arena) => void} [onArena] the vehicle, its room and course; first on each connection
 * @property {(cameras: import("./messages").Camera[]) => void} [onCameras] after one was changed
 * @property {(points: import("./messages").Track["points"], vehicle: string) => void} [onTrack] the track flown before the page came, of each vehicle
 * @property {(events: import("./messages").EventLine[]) => void} [onEvents] new ones, or again those before
 * @property {(state: import("./messages").State) => void} [onState] 20 times a second
 * @property {(kind: number, camera: number, jpeg: Uint8Array<ArrayBuffer>) => void} [onImage] kind: 0 colour, 1 depth, 2 objects
 * @property {(now_ms: number) => void} [onFrame] before the screen is painted
 * @property {() => void} [onTheme] the colours of the style sheet are others
 *
 * @typedef {Part & { element: HTMLElement }} Panel
 */

/** By column, from top to bottom, each with its name; `dialogs/panels.js` puts them where this browser wants them. */
export const PANELS = {
  left: { map: arenaView, crash: crashCard, timing, figures },
  right: { cameras: cameraImages, "camera settings": cameraSettings, sensors, leaderboard, events },
};
