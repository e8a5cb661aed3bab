// Prints one line per event on standard output, flushed at once. lines.py explains the lines.
#ifndef ROSRESCUE_LINES_H
#define ROSRESCUE_LINES_H

#include <cstdio>
#include <mutex>
#include <string>

inline void say(const std::string& line)
{
  static std::mutex lock;
  std::lock_guard<std::mutex> guard(lock);
  std::fputs((line + "\n").c_str(), stdout);
  std::fflush(stdout);
}

#endif
