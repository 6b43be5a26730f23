// WebSocket of one vehicle: JSON messages, and images as binary messages.

/**
 * Opens the WebSocket.
 * @param {string | null} vehicle default: the first one
 * @param {(message: import("./messages").Message) => void} onMessage
 * @param {(kind: number, camera: number, jpeg: Uint8Array<ArrayBuffer>) => void} onImage kind: 0 colour, 1 depth, 2 objects
 */
export function openSocket(vehicle, onMessage, onImage) {
  const query = vehicle == null ? "" : `?vehicle=${encodeURIComponent(vehicle)}`;
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${query}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") return onMessage(JSON.parse(data));
    const [kind, camera] = new Uint8Array(data, 0, 2);
    onImage(kind, camera, new Uint8Array(data, 2));
  };
  return socket;
}
