// The stream of states: opened again by itself when it is lost, and held for lost when two seconds pass without a beat.
const PATIENCE = 2000;

export function stream({ onState, onYard, onBeat, onLink }) {
  let source;
  let heard = 0;

  function open() {
    source?.close();
    heard = performance.now();
    source = new EventSource("/events");
    const listen = (name, act) =>
      source.addEventListener(name, (event) => {
        heard = performance.now();
        onLink("live");
        act(JSON.parse(event.data));
      });
    listen("state", onState);
    listen("yard", onYard);
    listen("beat", onBeat);
    source.onerror = () => onLink("lost");
  }

  open();
  setInterval(() => {
    if (performance.now() - heard < PATIENCE) return;
    onLink("lost");
    open();
  }, 250);
}
