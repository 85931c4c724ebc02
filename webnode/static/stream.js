// The stream of events: regarded as lost when it breaks, or when it is silent for some time.
// url() returns its URL for each connection; onMessage(name, data, id) is called per event, onLost() once at its end.
const PATIENCE = 1500;

export function createStream({ url, names, onMessage, onLost }) {
  let source = null;
  let at = 0;

  function close() {
    source?.close();
    source = null;
  }

  function fail() {
    close();
    onLost();
  }

  setInterval(() => {
    if (source && performance.now() - at > PATIENCE) fail();
  }, 100);

  return {
    close,
    open() {
      close();
      at = performance.now();
      const opened = source = new EventSource(url());
      for (const name of names) {
        source.addEventListener(name, (event) => {
          if (source !== opened) return;
          at = performance.now();
          onMessage(name, JSON.parse(event.data), event.lastEventId);
        });
      }
      source.onerror = () => { if (source === opened) fail(); };
    },
  };
}
