// The service worker: caches the page's files, so that the page opens without its node and connects to another node.
// Data of the team is never cached: no API, no stream, no picture.
const SHELL = "swarm.shell";
const PATIENCE = 1000;
const isShell = ({ pathname }) => pathname === "/" || pathname.startsWith("/static/");

addEventListener("install", () => skipWaiting());
addEventListener("activate", (event) => event.waitUntil(clients.claim()));

addEventListener("fetch", (event) => {
  const url = new URL(event.request.url);
  if (event.request.method !== "GET" || url.origin !== location.origin || !isShell(url)) return;
  event.respondWith(answer(event.request, url));
});

// Return the node's file if it arrives in time, so that an update shows immediately; otherwise the cached file.  A file that
// is not cached yet is not added here: the page caches all files together, because an incomplete page does not start.
async function answer(request, url) {
  const shell = await caches.open(SHELL);
  const kept = await shell.match(url.pathname);
  if (!kept) return fetch(request);
  const fresh = fetch(request).then((told) => {
    if (told.ok) shell.put(url.pathname, told.clone());
    return told;
  });
  const late = new Promise((done) => setTimeout(done, PATIENCE, kept));
  return Promise.race([fresh.catch(() => kept), late]);
}
