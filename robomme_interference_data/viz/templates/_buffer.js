"use strict";
// Shows frame after frame of the history: each session is a span of a stored video file.
const data = JSON.parse(document.getElementById("data").textContent);
const screens = [...document.querySelectorAll(".screen")];
const slider = document.getElementById("frame");
const play = document.getElementById("play");
const loaded = screens.map(() => null);  // the video file on each screen
let shown = -1, turn = 0, playing = false;

function numberOf(index) {
  return data.sessions.findIndex((session) => index < session.stop);
}

function load(place, file) {
  if (loaded[place]?.file === file) return loaded[place].ready;
  const video = document.createElement("video");
  const ready = new Promise((resolve) => {
    video.addEventListener("loadeddata", () => resolve(video), { once: true });
    video.addEventListener("error", () => {
      screens[place].textContent = "This browser cannot play the stored video (AV1 with RGB " +
        "pixels). Open the page in Chromium, Chrome or Edge.";
    });
  });
  video.muted = video.playsInline = true;
  video.preload = "auto";
  video.src = "data:video/mp4;base64," + document.getElementById(file).textContent;
  loaded[place] = { file, ready };
  return ready;
}

async function seek(video, time) {
  if (Math.abs(video.currentTime - time) > 1e-6) video.currentTime = time;
  // An event may belong to an earlier seek.
  while (video.seeking)
    await new Promise((resolve) => video.addEventListener("seeked", resolve, { once: true }));
}

async function show(index) {
  const mine = ++turn, number = numberOf(index), session = data.sessions[number];
  shown = index;
  slider.value = index;
  const row = document.querySelector(`#session-${number}`);
  const text = `Frame ${index} of ${data.frames}, session ${number}: ${row.dataset.name}`;
  document.getElementById("where").textContent = text;
  slider.setAttribute("aria-valuetext", text);
  document.getElementById("head").style.left = `${100 * (index + 0.5) / (data.frames + 1)}%`;
  for (const one of document.querySelectorAll("[data-session]"))
    one.classList.toggle("current", one.dataset.session === String(number));
  for (const one of document.querySelectorAll("[data-frame]"))
    one.classList.toggle("current", one.dataset.frame === String(index));
  const stored = session.first + Math.floor((index - session.start) / session.repeat);
  await Promise.all(screens.map(async (screen, place) => {
    const video = await load(place, session.files[place]);
    if (mine !== turn) return;
    await seek(video, (session.offsets[place] + stored + 0.5) / data.fps);
    if (mine === turn && video.parentNode !== screen) screen.replaceChildren(video);
  }));
}

function setPlaying(value) {
  playing = value;
  play.textContent = value ? "Pause" : "Play";
}

async function run() {
  setPlaying(true);
  let next = shown + 1 < data.frames ? shown + 1 : 0;
  while (playing && next < data.frames) {
    const began = performance.now();
    await show(next);
    const rest = 1000 / data.fps - (performance.now() - began);
    await new Promise((resolve) => setTimeout(resolve, Math.max(0, rest)));
    next = shown + 1;
  }
  setPlaying(false);
}

if (data.frames) {
  play.addEventListener("click", () => playing ? setPlaying(false) : run());
  slider.addEventListener("input", () => { setPlaying(false); show(Number(slider.value)); });
  document.addEventListener("click", (event) => {
    const target = event.target.closest("[data-frame]");
    if (target) { setPlaying(false); show(Number(target.dataset.frame)); }
  });
  show(0);
}
