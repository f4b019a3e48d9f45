// Core of the positioner's firmware: frames and commands in tvs_core.cpp, motion in tvs_motion.cpp.
// Portable C++11: no Arduino include, no heap, no floating point. The core accesses the board only through Hooks, so
// that it also runs natively and on an emulated processor in the tests, where it must agree byte by byte with
// tvsbayes/positioner/firmware_model.py.
// Protocol: tvsbayes/positioner/protocol.py. Times are microseconds since start, positions motor steps.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace tvs {

enum { kPan = 0, kTilt = 1, kAxes = 2 };

// Interface of a board to the core. Called only from start(), receive(), loop() and darkened(), never in an interrupt.
class Hooks {
 public:
  virtual void step(int axis, bool positive) = 0;
  virtual bool home_switch(int axis) = 0;
  virtual bool limit_switch(int axis) = 0;
  virtual void laser(bool on) = 0;
  virtual void trigger(bool on) = 0;
  virtual void write(const char* data, size_t size) = 0;

 protected:
  ~Hooks() {}
};

class Core {
 public:
  // boot_id: a number that differs between starts; it shows a host that counters were lost.
  Core(Hooks& hooks, uint32_t boot_id);
  // Switches the laser off and sends the banner. Call once, before all other functions.
  void start(uint64_t now_us);
  // Receives one byte from the host.
  void receive(uint8_t byte, uint64_t now_us);
  // Performs the actions due by now: at most one step of an axis, laser and trigger off. Must be called continuously.
  void loop(uint64_t now_us);
  // Time at which loop() is due next, if no request arrives before.
  uint64_t next_us() const;
  // Records that the board has switched the laser off because loop() was late.
  void darkened();

 private:
  enum Status { kUnhomed, kIdle, kMoving, kAlarm };
  enum Phase { kAway, kFast, kBack, kSlow };
  enum { kVmax, kAmax, kPmin, kPmax, kTmin, kTmax, kHp, kHt, kWd, kSettings };
  enum { kRequestMax = 96, kReplyMax = 192 };
  struct Axis {
    int32_t position, target, home_deviation;
    int32_t level;      // step number on the ramp: speed^2 = start^2 + 2 * acceleration * level
    int32_t direction;  // +1, -1; 0 at rest
    uint64_t due_us;
  };

  static const uint64_t kNever = UINT64_MAX;

  void line(uint64_t now_us);
  void nak(const char* kind);
  void send(const char* body, size_t size);
  void execute(uint32_t sequence, const char* words[], int count, uint64_t now_us);
  const char* command(uint32_t sequence, const char* words[], int count, uint64_t now_us, char* extra);
  const char* light(const char* word);
  const char* setting(const char* name, const char* word, char* extra);
  void reply(uint32_t sequence, const char* error, const char* extra);
  int switches(int axis);  // 1 home pressed + 2 limit open

  const char* move(uint32_t sequence, int32_t pan, int32_t tilt, uint64_t now_us);
  void stop();
  uint64_t laser_off_us() const;
  uint64_t step_us(int* axis) const;
  bool limit_open();
  void watch_limits(uint64_t now_us);
  uint32_t delay_us(int32_t level) const;
  int32_t top_level() const;
  void step_axis(int axis, uint64_t now_us);
  void finish_if_at_rest();
  void halt(Status status, const char* error);
  void set_laser(bool on);
  const char* home(uint32_t sequence, uint64_t now_us);
  void home_axis(int axis, uint64_t now_us);
  void home_phase(Phase phase, uint64_t now_us);
  uint32_t home_delay_us() const;
  void home_step(uint64_t now_us);
  void home_read(uint64_t now_us);
  void home_found(uint64_t now_us);

  Hooks& hooks_;
  const uint32_t boot_id_;
  Status status_;
  const char* error_;
  Axis axes_[kAxes];
  int32_t settings_[kSettings];
  uint32_t last_sequence_, motion_sequence_, done_sequence_;
  bool laser_, refused_, stopping_, homing_, homed_before_;
  int home_axis_;
  Phase home_phase_;
  int32_t home_clear_, home_travel_, home_reads_;
  bool home_limit_;
  uint64_t home_due_us_, heard_us_, trigger_off_us_, limit_due_us_;
  char request_[kRequestMax + 2], last_request_[kRequestMax + 2], last_reply_[kReplyMax + 8];
  size_t request_size_, last_request_size_, last_reply_size_;
  bool overlong_;
};

uint16_t crc16(const char* data, size_t size);

}  // namespace tvs
