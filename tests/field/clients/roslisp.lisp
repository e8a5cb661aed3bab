;;; A node of roslisp. tests/field/clients/measure.py describes what it does and prints.

(require :asdf)
(require :sb-posix)
(asdf:initialize-source-registry
 '(:source-registry (:tree "/usr/share/roslisp/") (:tree "/usr/share/common-lisp/ros/")
   :ignore-inherited-configuration))
(defvar *out* *standard-output*)
(let ((*standard-output* (make-broadcast-stream)) (*error-output* (make-broadcast-stream)))
  (handler-bind ((warning #'muffle-warning))
    (mapc #'asdf:load-system '(:roslisp :std_msgs-msg :std_srvs-srv))))

(defvar *name* (car (last sb-ext:*posix-argv*)))
(when (string= *name* "--compile") (sb-ext:exit))
(defvar *lock* (sb-thread:make-mutex))

(defun say (form &rest words)
  (sb-thread:with-mutex (*lock*)
    (format *out* "~a~%" (substitute #\Space #\Newline (apply #'format nil form words)))
    (finish-output *out*)))

(defun ms () (round (* 1000 (/ (get-internal-real-time) internal-time-units-per-second))))

;; Runs ACT every 200 ms, one at a time, and prints how long it took.
(defun forever (what act)
  (sb-thread:make-thread
   (lambda ()
     (loop for number from 1 do
       (let ((start (ms)))
         (handler-case
             (progn (funcall act number) (say "~a ~d ~d" what number (- (ms) start)))
           ((or error roslisp::ros-rpc-error) (why) (say "~a-failed ~d ~d ~a" what number (- (ms) start) why)))
         (sleep 0.2))))))

(roslisp:def-service-callback std_srvs-srv:Trigger ()
  (roslisp:make-response :success t :message ""))

(handler-bind ((warning #'muffle-warning))
  (roslisp:with-ros-node ((concatenate 'string "/" *name*))
    (let ((out (roslisp:advertise (format nil "/~a/out" *name*) "std_msgs/String"))
          (key (format nil "/~a/value" *name*))
          (server (format nil "/ref_~a/serve" *name*)))
      (roslisp:subscribe (format nil "/ref_~a/out" *name*) "std_msgs/String"
                         (lambda (message) (say "heard ~a" (std_msgs-msg:data message)))
                         :max-queue-length 100)
      (roslisp:register-service (format nil "/~a/serve" *name*) std_srvs-srv:Trigger)
      (say "ready")
      (forever "call" (lambda (number)
                        (declare (ignore number))
                        (roslisp:call-service server 'std_srvs-srv:Trigger)))
      (forever "param" (lambda (number)
                         (roslisp:set-param key number)
                         (let ((got (roslisp:get-param key)))
                           (unless (eql got number) (error "got ~a" got)))))
      (loop for number from 1
            while (eq (roslisp:node-status) :running)
            do (roslisp:publish-msg out :data (format nil "~d" number))
               (sleep 0.1))
      (say "shutdown"))))
(sb-ext:exit :abort t)
