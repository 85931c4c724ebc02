// A phone's camera: the picture for the team, and the values that the phone measures with each picture.
import { detectTarget } from "./detection.js";
import { text, textOf } from "./texts.js";

const SIDE = 208;
const DETECTION_SIDE = 104;
const DETECTION_MS = 200;
const QUALITY = 0.6;
const RAD = Math.PI / 180;

// The error names of browsers are codes of the catalogue.
export const describeCameraError = ({ name, message }) => textOf("camera.error", name, text("camera.error_other", { problem: message || name }));

// iOS asks for permission, and only in response to a tap; other browsers do not ask.
async function requestOrientation() {
  const { requestPermission } = globalThis.DeviceOrientationEvent ?? {};
  if (!requestPermission) return "DeviceOrientationEvent" in globalThis;
  return (await requestPermission.call(DeviceOrientationEvent).catch(() => "denied")) === "granted";
}

const clamp = (value, least, most) => Math.min(most, Math.max(least, value));

// Open the camera.  `canvas` shows the picture that the team gets; `onLost` is called when the camera stops.  Throws the
// browser's error.
export async function openCamera(canvas, sendsPosition, onLost) {
  // Both requests must belong to the same tap: iOS ignores a later request.
  const turns = requestOrientation();
  const wanted = { facingMode: "environment", width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 15 } };
  const stream = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
  const video = Object.assign(document.createElement("video"), { srcObject: stream, muted: true, playsInline: true });
  for (const track of stream.getTracks()) track.addEventListener("ended", onLost);
  const small = document.createElement("canvas");
  const measured = {};
  let detection = null;
  let detectedAt = -DETECTION_MS;
  let place = 0;

  const onOrientation = ({ alpha, beta, gamma }) => {
    if (alpha === null || beta === null || gamma === null) return;
    measured["orientation.yaw"] = clamp(alpha * RAD, 0, 2 * Math.PI);
    measured["orientation.pitch"] = clamp(beta * RAD, -Math.PI, Math.PI);
    measured["orientation.roll"] = clamp(gamma * RAD, -Math.PI, Math.PI);
  };
  const hasOrientation = await turns;
  if (hasOrientation) addEventListener("deviceorientation", onOrientation);
  if (sendsPosition) {
    place = navigator.geolocation?.watchPosition(({ coords }) => {
      measured["position.lat"] = coords.latitude;
      measured["position.lon"] = coords.longitude;
      measured["position.accuracy"] = clamp(coords.accuracy, 0, 1e6);
    }, () => {});
  }

  function drawScaled(to, side) {
    const scale = side / Math.max(video.videoWidth, video.videoHeight, 1);
    const [width, height] = [video.videoWidth, video.videoHeight].map((each) => Math.max(16, Math.round(each * scale)));
    if (to.width !== width || to.height !== height) Object.assign(to, { width, height });
    const pen = to.getContext("2d", { willReadFrequently: to === small });
    pen.drawImage(video, 0, 0, width, height);
    return pen;
  }

  function updateDetection(now) {
    if (now - detectedAt < DETECTION_MS) return;
    detectedAt = now;
    const { data } = drawScaled(small, DETECTION_SIDE).getImageData(0, 0, small.width, small.height);
    detection = detectTarget(data, small.width, small.height);
  }

  const camera = {
    has: { orientation: hasOrientation, position: sendsPosition && "geolocation" in navigator },
    // The current picture as bytes, the measured values, and the detection with its box and picture size in pixels.
    async capture() {
      updateDetection(performance.now());
      drawScaled(canvas, SIDE);
      const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg", QUALITY));
      if (!blob) throw new Error(text("camera.no_picture"));
      const values = { ...measured, ...(detection && { "target.bearing": detection.bearing, "target.distance": detection.distance }) };
      return { picture: await blob.arrayBuffer(), values, detection, of: { width: small.width, height: small.height } };
    },
    close() {
      for (const track of stream.getTracks()) track.stop();
      video.srcObject = null;
      removeEventListener("deviceorientation", onOrientation);
      if (place) navigator.geolocation.clearWatch(place);
    },
  };
  try {
    // Some phones start a video only after play(), and know its size only then.
    await video.play();
  } catch (fault) {
    camera.close();
    throw fault;
  }
  drawScaled(canvas, SIDE);
  return camera;
}
