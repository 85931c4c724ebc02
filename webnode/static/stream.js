// The stream of events: opened again by itself when it is lost, and held for lost when two seconds pass without a beat.
// url() gives its address, which changes with the ticket.
const PATIENCE = 2000;

export function stream(url, names, onEvent) {
  let source;
  let heard = 0;

  function open() {
    source?.close();
    heard = performance.now();
    source = new EventSource(url());
    for (const name of names) {
      source.addEventListener(name, (event) => {
        heard = performance.now();
        onEvent("link", "live");
        onEvent(name, JSON.parse(event.data));
      });
    }
    source.onerror = () => onEvent("link", "lost");
  }

  open();
  setInterval(() => {
    if (performance.now() - heard < PATIENCE) return;
    onEvent("link", "lost");
    open();
  }, 250);
}
