// The stream of events: regarded as lost when it breaks, or when it is silent for some time.
// url() returns its URL for each connection; heard(name, data, id) is called per event, lost() once at its end.
const PATIENCE = 1500;

export function stream({ url, names, heard, lost }) {
  let source = null;
  let at = 0;

  function close() {
    source?.close();
    source = null;
  }

  function fail() {
    close();
    lost();
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
          heard(name, JSON.parse(event.data), event.lastEventId);
        });
      }
      source.onerror = () => { if (source === opened) fail(); };
    },
  };
}
