// A phone's camera: the picture for the team, and the values that the phone measures with each picture.
import { sighted } from "./sight.js";

const SIDE = 208;
const SIGHT_SIDE = 104;
const SIGHT_MS = 200;
const QUALITY = 0.6;
const RAD = Math.PI / 180;

// Error names of browsers as text for people, with a remedy.
const REFUSALS = {
  NotAllowedError: "The camera is not allowed. Allow it for this page (next to the address, or in the browser's settings), then try again.",
  NotFoundError: "No camera was found. Connect one, or use another phone.",
  NotReadableError: "Another program uses the camera. Close it, then try again.",
  OverconstrainedError: "The camera does not support the picture size. Use another phone.",
  AbortError: "The camera did not start. Try again.",
};
export const why = ({ name, message }) => REFUSALS[name] ?? `The camera did not start: ${message || name}. Try again.`;

// iOS asks for permission, and only in response to a tap; other browsers do not ask.
async function orientation() {
  const { requestPermission } = globalThis.DeviceOrientationEvent ?? {};
  if (!requestPermission) return "DeviceOrientationEvent" in globalThis;
  return (await requestPermission.call(DeviceOrientationEvent).catch(() => "denied")) === "granted";
}

const between = (value, least, most) => Math.min(most, Math.max(least, value));

// Open the camera.  `canvas` shows the picture that the team gets; `lost` is called when the camera stops.  Throws the
// browser's error.
export async function opened(canvas, tellsPlace, lost) {
  // Both requests belong to the same tap: iOS ignores a later one.
  const turns = orientation();
  const wanted = { facingMode: "environment", width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 15 } };
  const stream = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
  const video = Object.assign(document.createElement("video"), { srcObject: stream, muted: true, playsInline: true });
  for (const track of stream.getTracks()) track.addEventListener("ended", lost);
  const small = document.createElement("canvas");
  const held = {};
  let sight = null;
  let sightAt = -SIGHT_MS;
  let place = 0;

  const onTurn = ({ alpha, beta, gamma }) => {
    if (alpha === null || beta === null || gamma === null) return;
    held["orientation.yaw"] = between(alpha * RAD, 0, 2 * Math.PI);
    held["orientation.pitch"] = between(beta * RAD, -Math.PI, Math.PI);
    held["orientation.roll"] = between(gamma * RAD, -Math.PI, Math.PI);
  };
  const hasOrientation = await turns;
  if (hasOrientation) addEventListener("deviceorientation", onTurn);
  if (tellsPlace) {
    place = navigator.geolocation?.watchPosition(({ coords }) => {
      held["position.lat"] = coords.latitude;
      held["position.lon"] = coords.longitude;
      held["position.accuracy"] = between(coords.accuracy, 0, 1e6);
    }, () => {});
  }

  function scaled(to, side) {
    const scale = side / Math.max(video.videoWidth, video.videoHeight, 1);
    const [width, height] = [video.videoWidth, video.videoHeight].map((each) => Math.max(16, Math.round(each * scale)));
    if (to.width !== width || to.height !== height) Object.assign(to, { width, height });
    const pen = to.getContext("2d", { willReadFrequently: to === small });
    pen.drawImage(video, 0, 0, width, height);
    return pen;
  }

  function find(now) {
    if (now - sightAt < SIGHT_MS) return;
    sightAt = now;
    const { data } = scaled(small, SIGHT_SIDE).getImageData(0, 0, small.width, small.height);
    sight = sighted(data, small.width, small.height);
  }

  const eye = {
    has: { orientation: hasOrientation, position: tellsPlace && "geolocation" in navigator },
    // The current picture as bytes, the measured values, and the detection with its box and picture size in pixels.
    async look() {
      find(performance.now());
      scaled(canvas, SIDE);
      const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg", QUALITY));
      if (!blob) throw new Error("no picture");
      const values = { ...held, ...(sight && { "target.bearing": sight.bearing, "target.distance": sight.distance }) };
      return { picture: await blob.arrayBuffer(), values, sight, of: { width: small.width, height: small.height } };
    },
    close() {
      for (const track of stream.getTracks()) track.stop();
      video.srcObject = null;
      removeEventListener("deviceorientation", onTurn);
      if (place) navigator.geolocation.clearWatch(place);
    },
  };
  try {
    // Some phones start a video only after play(), and know its size only then.
    await video.play();
  } catch (fault) {
    eye.close();
    throw fault;
  }
  scaled(canvas, SIDE);
  return eye;
}
